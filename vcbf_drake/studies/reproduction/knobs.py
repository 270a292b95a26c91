"""The method against its own knobs, one at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from vcbf_drake.simulation.loading import load_scenario
from vcbf_drake.studies.reproduction.archive import Archive
from vcbf_drake.studies.reproduction.section import Records, Section, text
from vcbf_drake.studies.reproduction.settings import Settings
from vcbf_drake.studies.reproduction.shares import WITH, WITHOUT, describe
from vcbf_drake.studies.reproduction.table_1 import paired_trials
from vcbf_drake.studies.trial import Record
from vcbf_drake.studies.variation import TABLE_I

SCENARIO = "blimp-multiple-obstacles"


@dataclass(frozen=True)
class Knob:
    """One quantity of the scenario and the values it takes.

    Attributes:
        label: What figures call it.
        unit: Its unit; empty for none.
        values: In the order of the results.
        overrides: Returns the overrides that set a value.
        methods: The filters that it concerns.
    """

    label: str
    unit: str
    values: Sequence[float]
    overrides: Callable[[float], dict[str, Any]]
    methods: Sequence[str] = (WITHOUT, WITH)


def knobs(settings: Settings) -> Section:
    """Returns the section: each value from the same random starts."""
    trials = [
        trial
        for knob in KNOBS.values()
        for value in knob.values
        for trial in paired_trials(
            SCENARIO,
            settings.knob_trials,
            TABLE_I[1],
            text(knob.overrides(value)),
            knob.methods,
        )
    ]

    def evaluate(archive: Archive, records: Records) -> Record:
        return {"description": _DESCRIPTION} | {
            name: {
                "label": knob.label,
                "unit": knob.unit,
                "points": [
                    _point(knob, value, records["knobs"]) for value in knob.values
                ],
            }
            for name, knob in KNOBS.items()
        }

    return Section("knobs", evaluate, studies={"knobs": trials})


def _point(knob: Knob, value: float, records: Sequence[Record]) -> Record:
    overrides = text(knob.overrides(value))
    own = [record for record in records if record["overrides"] == overrides]
    return {
        "value": value,
        "overrides": overrides,
        **{method: describe(own, method) for method in knob.methods},
    }


def _gain(value: float) -> dict[str, Any]:
    return {"volume": {"gain": value}}


def _threshold(value: float) -> dict[str, Any]:
    return {"volume": {"threshold": value}}


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


def _rate(value: float) -> dict[str, Any]:
    return {"period": 1.0 / value}


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
        "λ_Vv, the volume barrier's gain",
        "1/s",
        (0.3, 1.0, 3.0, 10.0, 30.0),
        _gain,
        (WITH,),
    ),
    "xi": Knob(
        "ξ, the volume barrier's threshold",
        "",
        (0.001, 0.005, 0.02, 0.05, 0.1),
        _threshold,
        (WITH,),
    ),
    "limits": Knob("all input limits, times", "", (0.75, 0.9, 1.0, 1.25, 1.5), _limits),
    "reverse_thrust": Knob(
        "reverse thrust over forward thrust",
        "",
        (0.15, 0.24, 0.4, 0.7, 1.0),
        _reverse_thrust,
    ),
    "rate": Knob("control rate", "Hz", (20.0, 50.0, 100.0, 200.0, 500.0), _rate),
    "noise": Knob(
        "standard deviation of the noise on every state",
        "SI",
        (0.0, 1e-4, 3e-4, 1e-3, 3e-3),
        _noise,
    ),
}

_DESCRIPTION = (
    "Test 2's course from Table I's random starts, one quantity changed at a time."
)
