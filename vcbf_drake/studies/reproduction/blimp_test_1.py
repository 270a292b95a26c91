"""Test 1 of the paper: a blimp passes one sphere in the wind, under every method."""

from __future__ import annotations

from typing import Any

from vcbf_drake.studies.reproduction.archive import Archive
from vcbf_drake.studies.reproduction.clearance import clearance
from vcbf_drake.studies.reproduction.estimation import estimation
from vcbf_drake.studies.reproduction.section import (
    Records,
    Section,
    entries,
    runs_under,
)
from vcbf_drake.studies.reproduction.settings import Settings
from vcbf_drake.studies.trial import Record

SCENARIO = "blimp-single-obstacle"
# The paper's four, and its filter without the volume barrier: with one obstacle
# "the proposed method" may be either (R48).
METHODS = (
    "dob-vcbf-qp",
    "dob-cbf-qp",
    "wang-xu-dob-cbf-qp",
    "robust-cbf-qp",
    "cbf-qp",
)


def test_1(settings: Settings) -> Section:
    """Returns the section: the reversing wind, and steady winds beside it."""
    runs = runs_under(METHODS, SCENARIO, "test_1")
    for number, (_, disturbance) in enumerate(_STEADY_WINDS, start=1):
        runs |= runs_under(
            METHODS,
            SCENARIO,
            f"test_1_steady_{number}",
            {"disturbance": disturbance},
        )

    def evaluate(archive: Archive, records: Records) -> Record:
        winds = [
            {
                "label": label,
                "wind": disturbance,
                "runs": entries(archive, runs, f"test_1_steady_{number}"),
            }
            for number, (label, disturbance) in enumerate(_STEADY_WINDS, start=1)
        ]
        return {
            "description": _DESCRIPTION,
            "command": f"vcbf-drake compare {SCENARIO} --methods {','.join(METHODS)}",
            "runs": entries(archive, runs, "test_1"),
            "steady_winds": winds,
            "estimation": estimation(archive.result("test_1/dob-vcbf-qp")),
            "clearances": {
                "text": _CLEARANCES,
                "rows": [clearance(archive.result(f"test_1/{m}")) for m in METHODS],
            },
        }

    return Section("test_1", evaluate, runs)


def _steady(strength: float) -> list[dict[str, Any]]:
    """A wind along the way and up that never reverses [m/s^2]."""
    return [
        _signal("Constant", value=[0.25 * strength, 0.0, 0.25 * strength]),
        _sinusoid([0.12 * strength, 0.0, 0.0], 1.0, 0.4),
        _sinusoid([0.0, 0.02, 0.0], 0.8, 1.5708),
        _sinusoid([0.0, 0.0, 0.12 * strength], 1.3, 0.0),
    ]


def _sinusoid(amplitude: list[float], frequency: float, phase: float) -> dict[str, Any]:
    return _signal("Sinusoid", amplitude=amplitude, frequency=frequency, phase=phase)


def _signal(kind: str, **fields: Any) -> dict[str, Any]:
    return {"_tag": f"!{kind}", **fields}


_STEADY_WINDS = (
    ("steady, 0.35 m/s^2 along the way and up", _steady(1.0)),
    ("steady, 0.71 m/s^2 along the way and up", _steady(2.0)),
)

_DESCRIPTION = (
    "One sphere on the straight way to the target. Start, target, sphere and all gains"
    " are the paper's; wind and thrust limits are ours. The main wind reverses; the"
    " steady ones stand beside it."
)
_CLEARANCES = (
    "While a barrier's row acts, d²h/dt² + k1 dh/dt + k2 h = n·d - Λ. Where the right"
    " side is steady, h settles at (n·d - Λ)/k2: Λ is what the method assumes of the"
    " disturbance along the normal n, so the clearance is its conservativeness over k2"
    " = 3.55 1/s², at the pace of the slow root, 0.37 1/s. `least` and `greatest` are"
    " the ends of (n·d - Λ)/k2 that the method's bounds allow; `integrated` is the"
    " least h of that equation through the contact in which the run came closest."
)
