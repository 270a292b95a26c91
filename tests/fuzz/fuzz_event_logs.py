"""LCM event logs: every event of the file, or one line that says what is wrong."""

from __future__ import annotations

from pathlib import Path
import tempfile

import atheris

with atheris.instrument_imports(include=["vcbf_drake.hil"]):
    from corpus import run

    from vcbf_drake import ScenarioError
    from vcbf_drake.hil.event_log import (
        EventLogError,
        EventLogWriter,
        logged_scenario,
        read_event_log,
    )

_FILE = Path(tempfile.mkdtemp()) / "log"


def target(data: bytes) -> None:
    _FILE.write_bytes(data)
    try:
        events, damage = read_event_log(_FILE)
        assert len(damage.splitlines()) <= 1
        assert sum(len(event.data) for event in events) <= len(data)
        logged_scenario(_FILE, events)
    except (EventLogError, ScenarioError) as error:
        assert str(error).isprintable(), "one line"


def _seeds() -> list[bytes]:
    seeds = []
    for number in range(3):
        with EventLogWriter(_FILE) as log:
            log(1_000, "VCBF_SCENARIO", b"a: {duration: 1}")
            for each in range(number):
                log(2_000 + each, "VCBF_STATE", bytes(10 * each))
        seeds.append(_FILE.read_bytes())
    return seeds


if __name__ == "__main__":
    run(target, _seeds(), ["\\xed\\xa1\\xda\\x01", "VCBF_SCENARIO"])
