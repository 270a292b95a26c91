"""A counter-example: where the observer's chatter alone empties the feasible set."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from vcbf_drake.studies import Record, Trial
from vcbf_drake.viz.series_figures import draw_volume
from vcbf_drake.viz.style import METHOD_STYLES

from .archive import Archive
from .experiment import (
    WITH,
    WITHOUT,
    Experiment,
    Numbers,
    Plan,
    Records,
    Settings,
    describe,
    entries,
    paired_trials,
    runs_under,
    text,
)
from .figures import cases_figure, error_figure
from .one_obstacle import estimation
from .report import Block, Figure
from .table_1 import RANDOM_STARTS
from .words import endings, label, percent, runs_table, significant, trials_table

SCENARIO = "blimp-multiple-obstacles"
COMPARED = (WITH, WITHOUT)

# Observer steps per control period, and how they are taken. The runs that are kept
# whole use the third, and the same rate taken implicitly.
_STEPS = (
    ("implicit", 1),
    ("implicit", 6),
    ("explicit", 10),
    ("explicit", 8),
    ("explicit", 6),
    ("explicit", 5),
)
_KEPT = ("explicit", 6), ("implicit", 6)
_PERIOD = 0.02
_SPHERES = (
    ([9.47, 1.67, 2.38], 0.9),
    ([4.53, 1.49, 0.89], 1.03),
    ([9.39, 2.45, 0.44], 0.79),
    ([3.3, 0.38, 0.61], 1.08),
    ([4.08, -0.1, 1.05], 0.91),
    ([9.36, 2.12, 1.11], 0.52),
)


def plan(settings: Settings) -> Plan:
    """Returns one course, its observer stepped in different ways."""
    runs: dict[str, Trial] = {}
    for step, count in _KEPT:
        runs |= runs_under(COMPARED, SCENARIO, f"test_2_{step}", _course(step, count))
    studies = {
        _file(step, count): paired_trials(
            SCENARIO,
            settings.chatter_trials,
            RANDOM_STARTS,
            text(_course(step, count)),
        )
        for step, count in _STEPS
    }

    def evaluate(archive: Archive, records: Records) -> Record:
        observers = [
            {
                "step": step,
                "rate": count / _PERIOD,
                **{m: describe(records[_file(step, count)], m) for m in COMPARED},
            }
            for step, count in _STEPS
        ]
        twins = {
            step: {
                "runs": entries(archive, runs, f"test_2_{step}"),
                "estimation": estimation(archive.result(f"test_2_{step}/{WITH}")),
            }
            for step, _ in _KEPT
        }
        return {"observer_rate": _KEPT[0][1] / _PERIOD, **twins, "observers": observers}

    return Plan(evaluate, runs, studies)


def _file(step: str, count: int) -> str:
    return f"test_2_{step}_{count / _PERIOD:.0f}_hz"


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
    numbers = {"amplitude": amplitude, "frequency": frequency, "phase": phase}
    return {"_tag": "!Sinusoid", **numbers}


def show(numbers: Numbers, archive: Archive) -> Iterator[Block]:
    """Yields the same course with the observer stepped explicitly and implicitly."""
    rate, command = numbers["observer_rate"], numbers["command"]
    twins = {
        f"{step} observer, {rate:g} Hz": numbers[step]
        for step in ("explicit", "implicit")
    }
    yield (
        "A counterexample, not a demonstration: the equations as printed, weak"
        " symmetric thrust, control at 50 Hz. Only the discretisation of the observer"
        " differs. The explicit step chatters, the more the slower it is, and below"
        " some rate the chatter alone empties the feasible set of dob-cbf-qp; the"
        " implicit step does not chatter. Whether the paper's own Test 2 has this"
        " cause is unknown, since the paper does not state its discretisation. Starts"
        " as in Table I, case 1."
    )
    yield (
        "Differences from the prototype in which this layout was found: the observer"
        " uses the three disturbed channels, not all eight; its rates are varied,"
        " because at the prototype's 500 Hz the effect is marginal; the integrator is"
        " Drake's."
    )
    yield Figure(
        "test_2_explicit",
        "One course, twice: paths from above and the volume barrier *Vᵥ*, with the"
        " observer stepped explicitly (above) and implicitly (below). Only the"
        f" observer's step differs. {_endings(twins)}",
        lambda: cases_figure(
            [(words, archive.labelled(twin["runs"])) for words, twin in twins.items()],
            (0, 1),
            draw_volume,
            share=0.55,
        ),
        command,
    )
    yield Figure(
        "test_2_explicit_errors",
        "The norm of the estimate's error (line) and the bound that the filter used"
        f" (grey area) in the same runs, in decades. {_errors(twins)}",
        lambda: error_figure(
            [
                (words, archive.labelled(twin["runs"])[-1])
                for words, twin in twins.items()
            ]
        ),
        command,
    )
    yield runs_table(
        "Explicit and implicit observer on one course.",
        [(words, twin["runs"]) for words, twin in twins.items()],
        "m",
        command,
    )
    yield trials_table(
        "The same course from random starts, with different discretisations of the"
        " observer: the faster the explicit step, the less it chatters.",
        ["observer", "rate [Hz]", "method"],
        [
            ([each["step"], f"{each['rate']:g}", label(method)], each[method])
            for each in numbers["observers"]
            for method in METHOD_STYLES
            if method in each
        ],
        command,
    )


def _endings(twins: Numbers) -> str:
    return " ".join(
        f"{words.split()[0].capitalize()}: {endings(twin['runs'])}"
        for words, twin in twins.items()
    )


def _errors(twins: Numbers) -> str:
    parts = [
        f"{words.split()[0]}, at most"
        f" {significant(twin['estimation']['greatest_error'], 2)} m/s² after the first"
        " second and above that bound in"
        f" {percent(twin['estimation']['above_certified_bound'])} of the ticks"
        for words, twin in twins.items()
    ]
    strongest = max(
        twin["estimation"]["greatest_disturbance"] for twin in twins.values()
    )
    return (
        f"The disturbance is at most {significant(strongest, 2)} m/s²; the error is:"
        f" {'; '.join(parts)}."
    )


EXPERIMENT = Experiment(
    "test_2_explicit", "Beside Test 2: an observer that chatters", plan, show
)
