"""The method against its own knobs, one at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from vcbf_drake.simulation.loading import load_scenario
from vcbf_drake.studies import Record

from .archive import Archive, in_drawing_order
from .experiment import (
    WITH,
    WITHOUT,
    Experiment,
    Numbers,
    Plan,
    Records,
    Settings,
    describe,
    paired_trials,
    text,
)
from .figures import KnobColumn, knob_figure
from .report import Block, Figure
from .table_1 import RANDOM_STARTS
from .words import label, trials_table

SCENARIO = "blimp-multiple-obstacles"


@dataclass(frozen=True)
class Knob:
    """One quantity of the scenario and the values it takes.

    Attributes:
        label: What figures call it, with its unit.
        values: In the order of the results.
        overrides: Returns the overrides that set a value.
        methods: The filters that it concerns.
    """

    label: str
    values: Sequence[float]
    overrides: Callable[[float], dict[str, Any]]
    methods: Sequence[str] = (WITHOUT, WITH)


def _limits(value: float) -> dict[str, Any]:
    limits = load_scenario(SCENARIO).input_set
    return {
        "input_set": {
            "lower": [round(value * bound, 6) for bound in limits.lower],
            "upper": [round(value * bound, 6) for bound in limits.upper],
        }
    }


def _reverse_thrust(value: float) -> dict[str, Any]:
    limits = load_scenario(SCENARIO).input_set
    return {
        "input_set": {"lower": [round(-value * limits.upper[0], 6), *limits.lower[1:]]}
    }


def _noise(value: float) -> dict[str, Any]:
    """White noise of the same size on every state, with the step made for it."""
    if value == 0.0:
        return {}
    layer = 20.0 * value  # Of the 10 to 50 standard deviations that are advised.
    return {
        "noise": {"std": [value] * 8},
        "observer": {"step": "saturated", "boundary_layer": layer},
    }


KNOBS = {
    "lambda_Vv": Knob(
        "λ_Vv, the volume barrier's gain\u00a0[1/s]",
        (0.3, 1.0, 3.0, 10.0, 30.0),
        lambda value: {"volume": {"gain": value}},
        (WITH,),
    ),
    "xi": Knob(
        "ξ, the volume barrier's threshold\u00a0[-]",
        (0.001, 0.005, 0.02, 0.05, 0.1),
        lambda value: {"volume": {"threshold": value}},
        (WITH,),
    ),
    "limits": Knob(
        "all input limits, times\u00a0[-]", (0.75, 0.9, 1.0, 1.25, 1.5), _limits
    ),
    "reverse_thrust": Knob(
        "reverse thrust over forward thrust\u00a0[-]",
        (0.15, 0.24, 0.4, 0.7, 1.0),
        _reverse_thrust,
    ),
    "rate": Knob(
        "control rate\u00a0[Hz]",
        (20.0, 50.0, 100.0, 200.0, 500.0),
        lambda value: {"period": 1.0 / value},
    ),
    "noise": Knob(
        "standard deviation of the noise on every state\u00a0[SI]",
        (0.0, 1e-4, 3e-4, 1e-3, 3e-3),
        _noise,
    ),
}


def plan(settings: Settings) -> Plan:
    """Returns each value from the same random starts."""
    trials = [
        trial
        for knob in KNOBS.values()
        for value in knob.values
        for trial in paired_trials(
            SCENARIO,
            settings.knob_trials,
            RANDOM_STARTS,
            text(knob.overrides(value)),
            knob.methods,
        )
    ]

    def evaluate(archive: Archive, records: Records) -> Record:
        return {
            name: {
                "label": knob.label,
                "points": [
                    _point(knob, value, records["knobs"]) for value in knob.values
                ],
            }
            for name, knob in KNOBS.items()
        }

    return Plan(evaluate, studies={"knobs": trials})


def _point(knob: Knob, value: float, records: Sequence[Record]) -> Record:
    overrides = text(knob.overrides(value))
    own = [record for record in records if record["overrides"] == overrides]
    return {"value": value, **{m: describe(own, m) for m in knob.methods}}


def show(numbers: Numbers, archive: Archive) -> Iterator[Block]:
    """Yields running times and arrivals against every knob."""
    command = numbers["command"]
    columns = [_column(numbers[name]) for name in KNOBS]
    yield (
        "Test 2's course from Table I's random starts, one quantity changed at a time."
    )
    yield Figure(
        "knobs",
        "One setting varied at a time, a column each, the others as in Test 2: above,"
        " the mean running time with its 95 % interval; below, the share of trials that"
        " arrive.",
        lambda: knob_figure(columns),
        command,
    )
    for column in columns:
        yield trials_table(
            f"In numbers: {column.label}.",
            ["value", "method"],
            [
                ([value, label(method)], trials[place])
                for place, value in enumerate(column.values)
                for method, trials in column.trials.items()
            ],
            command,
        )


def _column(numbers: Numbers) -> KnobColumn:
    points = numbers["points"]
    return KnobColumn(
        numbers["label"],
        [f"{point['value']:g}" for point in points],
        {
            method: [point[method] for point in points]
            for method in in_drawing_order(points[0])
        },
    )


EXPERIMENT = Experiment("knobs", "The method against its own knobs", plan, show)
