"""The messages: generated as committed, and decoded only when all of them is right."""

from __future__ import annotations

from pathlib import Path
import shutil
import subprocess
import sys

import numpy as np
import pytest

from vcbf_drake.hil.decoding import (
    MessageFormat,
    Rejection,
    command_format,
    obstacles_format,
    state_format,
    status_format,
)

MESSAGES = Path(__file__).parents[1] / "vcbf_drake" / "hil" / "messages"
NOW = 1_700_000_000_000_000  # In microseconds since 1970.
SECOND = 1_000_000
FORMATS = [
    state_format(8, 3),
    command_format(3),
    status_format(3, 7, 3),
    obstacles_format(7, 3),
]


def generator() -> str | None:
    """The path of lcm-gen, beside this Python or on the path."""
    beside = Path(sys.executable).parent / "lcm-gen"
    return str(beside) if beside.exists() else shutil.which("lcm-gen")


def without_version(text: str) -> str:
    lines = text.splitlines()
    return "\n".join(line for line in lines if not line.startswith("lcm-gen "))


@pytest.mark.skipif(generator() is None, reason="lcm-gen is not installed (extra lcm)")
def test_committed_python_is_what_the_generator_makes(tmp_path: Path) -> None:
    sources = sorted(map(str, MESSAGES.glob("*.lcm")))
    command = [generator(), "--python", "--ppath", str(tmp_path), *sources]
    subprocess.run(command, check=True, capture_output=True)
    made = {path.name: path.read_text() for path in tmp_path.rglob("*.py")}
    committed = {path.name: path.read_text() for path in MESSAGES.glob("*.py")}
    assert made.keys() == committed.keys()
    for name in made:
        assert without_version(made[name]) == without_version(committed[name]), name


def message(form: MessageFormat, **values: object):
    """A message that nothing is wrong with, but for the values given."""
    made = form.type()
    made.version, made.session, made.sequence = 1, NOW - 10 * SECOND, 5
    made.utime = NOW - 1000
    for name, size in form.sizes.items():
        setattr(made, name, size)
    rng = np.random.default_rng(3)
    for name, sizes in zip(made.__slots__, made.__dimensions__, strict=True):
        if sizes:
            size = getattr(made, sizes[0])
            setattr(made, name, rng.uniform(-1.0, 1.0, size).tolist())
    if hasattr(made, "utime_measured"):
        made.utime_measured, made.time = NOW - 2000, 1.5
    if hasattr(made, "valid"):
        made.valid = [True] * made.num_obstacles
    if hasattr(made, "conflicts"):
        made.num_conflicts, made.conflicts = 2, ["obstacle 1", "obstacle 2"]
    for name, value in values.items():
        setattr(made, name, value)
    return made


@pytest.mark.parametrize("form", FORMATS, ids=lambda form: form.channel)
def test_a_good_message_comes_back_as_it_was(form: MessageFormat) -> None:
    sent = message(form)
    found = form.decode(sent.encode(), NOW)
    assert not isinstance(found, Rejection)
    for name in sent.__slots__:
        value, expected = getattr(found, name), getattr(sent, name)
        assert (list(value) if isinstance(value, tuple) else value) == expected
