"""A counter-example: where the observer's chatter alone empties the feasible set."""

from __future__ import annotations

from typing import Any

from vcbf_drake.studies.reproduction.archive import Archive
from vcbf_drake.studies.reproduction.estimation import estimation
from vcbf_drake.studies.reproduction.section import (
    Records,
    Section,
    entries,
    runs_under,
    text,
)
from vcbf_drake.studies.reproduction.settings import Settings
from vcbf_drake.studies.reproduction.shares import WITH, WITHOUT, describe
from vcbf_drake.studies.reproduction.table_1 import paired_trials
from vcbf_drake.studies.trial import Record, Trial
from vcbf_drake.studies.variation import TABLE_I

SCENARIO = "blimp-multiple-obstacles"
METHODS = (WITH, WITHOUT)

# Observer steps per control period of 20 ms, and how they are taken. The runs that are
# kept whole use the third, and the same rate taken implicitly.
_STEPS = (
    ("implicit", 1),
    ("implicit", 6),
    ("explicit", 10),
    ("explicit", 8),
    ("explicit", 6),
    ("explicit", 5),
)
_KEPT = ("explicit", 6), ("implicit", 6)


def test_2_explicit(settings: Settings) -> Section:
    """Returns the section: one course, its observer stepped in different ways."""
    runs: dict[str, Trial] = {}
    for step, count in _KEPT:
        runs |= runs_under(METHODS, SCENARIO, f"test_2_{step}", _course(step, count))
    studies = {
        _file(step, count): paired_trials(
            SCENARIO,
            settings.chatter_trials,
            TABLE_I[1],
            text(_course(step, count)),
        )
        for step, count in _STEPS
    }

    def evaluate(archive: Archive, records: Records) -> Record:
        observers = [
            {
                "step": step,
                "rate": _rate(count),
                "file": f"studies/{_file(step, count)}.jsonl",
                **{m: describe(records[_file(step, count)], m) for m in METHODS},
            }
            for step, count in _STEPS
        ]
        return {
            "description": _DESCRIPTION,
            "differences": _DIFFERENCES,
            "observer_rate": _rate(_KEPT[0][1]),
            **{
                step: {
                    "runs": entries(archive, runs, f"test_2_{step}"),
                    "estimation": estimation(archive.result(f"test_2_{step}/{WITH}")),
                }
                for step, _ in _KEPT
            },
            "observers": observers,
        }

    return Section("test_2_explicit", evaluate, runs, studies)


def _file(step: str, count: int) -> str:
    return f"test_2_{step}_{_rate(count):.0f}_hz"


def _rate(count: int) -> float:
    return count / _PERIOD


def _course(step: str, count: int) -> dict[str, Any]:
    """A course with weak symmetric thrust; the observer steps `count` times a tick."""
    return {
        "name": f"blimp-{step}-observer",
        "vehicle": {
            "_tag": "!Blimp",
            "mass": 1.0,
            "added_mass": [0.0, 0.0, 0.0],
            "drag": [0.1, 0.1, 0.1],
            "yaw_inertia": 0.2,
            "yaw_drag": 0.24,
            "controller": {
                "surge_gain": 1.4,
                "position_gain": 0.31,
                "heave_gain": 1.4,
                "height_gain": 0.9,
                "yaw_gain": 1.0,
                "yaw_rate_gain": 0.0,
                "drift_gain": 0.0,
            },
        },
        "input_set": {"lower": [-0.41, -0.41, -0.5], "upper": [0.41, 0.41, 0.5]},
        "disturbance": [
            _sinusoid([0.075, 0.0, 0.0], 0.8, 0.0),
            _sinusoid([0.0, 0.0375, 0.0], 0.5, 1.5708),
            _sinusoid([0.0, 0.0, 0.075], 0.6, 1.0),
        ],
        "obstacles": [
            {"center": center, "radius": radius} for center, radius in _SPHERES
        ],
        "observer": {"step": step, "period": _PERIOD / count},
        "fidelity": "paper",
        "volume": {"threshold": 0.00284, "slack_penalty": 1e6},
        "initial_state": [0.0] * 8,
        "duration": 25.0,
        "period": _PERIOD,
    }


def _sinusoid(amplitude: list[float], frequency: float, phase: float) -> dict[str, Any]:
    return {
        "_tag": "!Sinusoid",
        "amplitude": amplitude,
        "frequency": frequency,
        "phase": phase,
    }


_PERIOD = 0.02
_SPHERES = (
    ([9.47, 1.67, 2.38], 0.9),
    ([4.53, 1.49, 0.89], 1.03),
    ([9.39, 2.45, 0.44], 0.79),
    ([3.3, 0.38, 0.61], 1.08),
    ([4.08, -0.1, 1.05], 0.91),
    ([9.36, 2.12, 1.11], 0.52),
)

_DESCRIPTION = (
    "A counter-example, not a demonstration: the equations as printed, weak symmetric"
    " thrust, control at 50 Hz. Only how the observer takes its steps differs. Stepped"
    " explicitly it chatters, the more the slower it steps, and below some rate that"
    " alone empties the feasible set of dob-cbf-qp; its twin, stepped implicitly, knows"
    " nothing of it. Whether the paper's own Test 2 shares this cause is not known: it"
    " does not say how it steps the observer. Starts as in Table I, case 1."
)
_DIFFERENCES = (
    "Against the prototype that found this layout: the observer sees the three"
    " disturbed channels, not all eight; its rates are varied, for at the prototype's"
    " 500 Hz the effect is on the edge; the integrator is Drake's."
)
