"""The messages: generated as committed, and decoded only when all of them is right."""

from __future__ import annotations

from pathlib import Path
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest

from vcbf_drake.hil import (
    MessageFormat,
    Reason,
    Rejection,
    command_format,
    obstacles_format,
    state_format,
)

MESSAGES = Path(__file__).parents[2] / "vcbf_drake" / "hil" / "messages"
NOW = 1_700_000_000_000_000  # In microseconds since 1970.
SECOND = 1_000_000
FORMATS = [
    state_format(8, 3),
    command_format(3),
    obstacles_format(),
]


def generator() -> str | None:
    """The path of lcm-gen, beside this Python or on the path."""
    beside = Path(sys.executable).parent / "lcm-gen"
    return str(beside) if beside.exists() else shutil.which("lcm-gen")


def generates_the_same(path: str | None) -> bool:
    """Whether there is a generator, and not one before 1.5, which writes otherwise."""
    if path is None:
        return False
    told = subprocess.run([path, "--version"], capture_output=True, text=True)
    version = re.search(r"(\d+)\.(\d+)", told.stdout + told.stderr)
    return version is not None and tuple(map(int, version.groups())) >= (1, 5)


def without_version(text: str) -> str:
    lines = text.splitlines()
    return "\n".join(line for line in lines if not line.startswith("lcm-gen "))


@pytest.mark.skipif(
    not generates_the_same(generator()), reason="no lcm-gen of 1.5 or later (extra lcm)"
)
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
    made.version, made.session, made.sequence = 2, NOW - 10 * SECOND, 5
    made.utime = NOW - 1000
    sizes = form.sizes or {"num_obstacles": 7, "num_coordinates": 21}
    for name, size in sizes.items():
        setattr(made, name, size)
    rng = np.random.default_rng(3)
    for name, lengths in zip(made.__slots__, made.__dimensions__, strict=True):
        if lengths:
            size = getattr(made, lengths[0])
            setattr(made, name, rng.uniform(-1.0, 1.0, size).tolist())
    if hasattr(made, "utime_measured"):
        made.utime_measured, made.time = NOW - 2000, 1.5
    if hasattr(made, "valid"):
        made.valid = [True] * made.num_obstacles
    if hasattr(made, "conflicts"):
        made.num_conflicts, made.conflicts = 2, ["obstacle 1", "obstacle 2"]
        made.num_findings, made.findings = 1, ["the state stands still"]
    for name, value in values.items():
        setattr(made, name, value)
    return made


@pytest.mark.parametrize("form", FORMATS, ids=lambda form: form.channel)
def test_a_good_message_comes_back_as_it_was(form: MessageFormat) -> None:
    sent = message(form)
    found = form.decode(sent.encode())
    assert not isinstance(found, Rejection)
    for name in sent.__slots__:
        value, expected = getattr(found, name), getattr(sent, name)
        assert (list(value) if isinstance(value, tuple) else value) == expected


def test_a_vehicle_may_run_for_weeks() -> None:
    """A thrust of 2 kN over a fortnight: what was applied adds up, and so does time."""
    fortnight = 14 * 24 * 3600.0
    sent = message(FORMATS[0], time=fortnight, input_integral=[2e3 * fortnight] * 3)
    assert not isinstance(FORMATS[0].decode(sent.encode()), Rejection)


FLAWS = {
    "version": (1, Reason.VERSION),
    "session": (0, Reason.STAMPS),
    "sequence": (-1, Reason.STAMPS),
    "utime": (0, Reason.STAMPS),
}


@pytest.mark.parametrize("form", FORMATS, ids=lambda form: form.channel)
@pytest.mark.parametrize("name", FLAWS)
def test_a_flaw_that_any_message_can_have_is_named(form, name) -> None:
    value, reason = FLAWS[name]
    flawed = message(form, **{name: value})
    assert form.decode(flawed.encode()) == Rejection(reason)


@pytest.mark.parametrize(
    ("form", "name", "value", "reason"),
    [
        (FORMATS[0], "utime_measured", NOW, Reason.STAMPS),
        (FORMATS[0], "utime_measured", 0, Reason.STAMPS),
        (FORMATS[0], "time", -1.0, Reason.STAMPS),
        (FORMATS[0], "time", float("nan"), Reason.NUMBER),
        (FORMATS[0], "mode", 4, Reason.CODE),
        (FORMATS[0], "mode", -1, Reason.CODE),
        (FORMATS[0], "state", [float("nan")] * 8, Reason.NUMBER),
        (FORMATS[0], "state", [0.0] * 7 + [float("inf")], Reason.NUMBER),
        (FORMATS[0], "state", [0.0] * 7 + [-1e300], Reason.NUMBER),
        (FORMATS[0], "input_integral", [float("nan")] * 3, Reason.NUMBER),
        (FORMATS[0], "input_integral", [0.0, 0.0, 1e300], Reason.NUMBER),
        (FORMATS[1], "input", [0.0, 0.0, float("inf")], Reason.NUMBER),
        (FORMATS[1], "mode", 100, Reason.CODE),
        (FORMATS[2], "position", [float("nan")] * 21, Reason.NUMBER),
    ],
)
def test_a_flaw_is_named(form, name, value, reason) -> None:
    flawed = message(form, **{name: value})
    assert form.decode(flawed.encode()) == Rejection(reason)


def test_a_rejection_says_what_was_found() -> None:
    words = {
        "num_states": "array of another size (num_states is 8, not 4)",
        "version": "unknown version (1, ours is 2)",
        "mode": "unknown code (mode 7)",
        "state": "not a finite number of sensible size (state)",
    }
    flawed = {"version": 1, "mode": 7, "state": [float("nan")] * 8}
    for name, expected in words.items():
        form = state_format(4, 3) if name == "num_states" else FORMATS[0]
        values = {name: flawed[name]} if name in flawed else {}
        found = form.decode(message(FORMATS[0], **values).encode())
        assert found.words == expected


def test_a_signed_message_where_no_key_is_set_is_called_so() -> None:
    found = FORMATS[0].decode(message(FORMATS[0]).encode() + bytes(32))
    assert found == Rejection(Reason.LENGTH)
    assert found.words == "wrong length (as if it were signed; no key_file is set here)"


@pytest.mark.parametrize("form", FORMATS, ids=lambda form: form.channel)
def test_every_truncation_and_every_addition_is_refused(form) -> None:
    data = message(form).encode()
    for size in range(len(data)):
        found = form.decode(data[:size])
        assert found in (Rejection(Reason.TYPE), Rejection(Reason.LENGTH))
    assert form.decode(data + b"\0") == Rejection(Reason.LENGTH)
    assert form.decode(data + bytes(70_000)) == Rejection(Reason.LENGTH)


@pytest.mark.parametrize("form", FORMATS, ids=lambda form: form.channel)
def test_arrays_of_other_sizes_are_refused_whether_or_not_they_are_there(form) -> None:
    for name, size in form.sizes.items():
        other = message(form)
        for array, sizes in zip(other.__slots__, other.__dimensions__, strict=True):
            if sizes == [name]:
                setattr(other, array, 2 * getattr(other, array))
        setattr(other, name, size + 1)
        assert form.decode(other.encode()) == Rejection(Reason.SIZE)
        # The size alone, as the four bytes where it is written.
        data = message(form).encode()
        place = data.index(size.to_bytes(4, "big"), 20)
        for forged in (2**31 - 1, -1, -(2**31), 0):
            changed = forged.to_bytes(4, "big", signed=True)
            found = form.decode(data[:place] + changed + data[place + 4 :])
            assert isinstance(found, Rejection)


@pytest.mark.parametrize("form", FORMATS, ids=lambda form: form.channel)
def test_another_channels_message_is_not_taken(form) -> None:
    for other in FORMATS:
        found = form.decode(message(other).encode())
        if other is not form:
            assert found == Rejection(Reason.TYPE)
