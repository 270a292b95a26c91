"""From 20 Hz to 1 kHz: what happens between ticks, with and without a margin.

`python -m examples.paper.rates > docs/results/between_ticks.md` makes that page, in
some minutes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import sys
from typing import Any

from vcbf_drake.safety import BETWEEN_TICKS
from vcbf_drake.simulation.loading import load_scenario
from vcbf_drake.simulation.run import simulate
from vcbf_drake.viz.terminal import rounded_down

from .car_experiments import AVOIDANCE, POINT
from .moving_wall import press_against_wall
from .words import table

RATES = (20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
MOVING_WALL = "moving wall"
SCENARIOS = ("car-avoidance", "blimp-single-obstacle")

# How densely h is looked at in the scenarios [s].
_STEP = 1e-3
_COLUMNS = {
    "min_barrier": ("least h seen", ".3g"),
    "certified_min_barrier": ("certified", "down"),
    "median_barrier": ("median h", ".3g"),
    "reached_at": ("reached [s]", ".2f"),
    "min_volume": ("least V_v", ".4g"),
    "max_abs_slack": ("greatest slack", ".3g"),
    "infeasible_ticks": ("infeasible ticks", "d"),
}

_PAGE = """\
# Between ticks, from 20 Hz to 1 kHz

Produced by `python -m examples.paper.rates`.

The filter enforces its rows at the ticks, and the input is held in between. Each case
runs at every rate twice: with `between_ticks: none`, and with `between_ticks:
certified`, which chooses inputs under which the rows hold until the next tick (E88).
All runs use the method dob-vcbf-qp and, at infeasible ticks, the input of least
violation.

*Least h seen* is the least value at steps of 1 ms at most. *Certified* is a lower bound
of h at every instant, for every disturbance that agrees with the knowledge at the ticks
(E87). The labels are those of [theory.md](../theory.md).
"""

_ABOUT = {
    MOVING_WALL: """\
The reference presses a car with full force against a wall that moves to and fro, 0.5 m
to either side at 2 rad/s; h is its distance [m]. The row is active at every tick, and
its right-hand side changes during the hold. The observer has to estimate a constant
disturbance of 0.2 m/s^2; since it is constant, the hold margin (E28) is 0 and hides
nothing. *Median h* is the distance that the car keeps, the price of the margin.""",
    "car-avoidance": """\
The shipped scenario, with a car that is a point; h in m^2. The obstacle is round and
static, and a car that drives straight on moves away from it, so that both the loss
between ticks and the margin are small.""",
    "blimp-single-obstacle": """\
The shipped scenario; h in m. A reversing wind presses the blimp against a sphere. At
20 Hz its yaw and speed change considerably within a period, and h is kept larger; from
50 Hz on the margin costs a millimetre, from 100 Hz on nothing that is visible.""",
}

Record = dict[str, Any]


def sweep(rates: Sequence[float] = RATES) -> Iterator[str]:
    """Yields the page, a part as soon as it is measured.

    Args:
        rates: Control rates [Hz].
    """
    yield _PAGE
    for case, about in _ABOUT.items():
        kinds = [(rate, setting) for rate in rates for setting in BETWEEN_TICKS]
        found = [_run(case, *kind) for kind in kinds]
        yield f"## {case}\n"
        yield _table(about, kinds, found) + "\n"


def _run(case: str, rate: float, between_ticks: Any) -> Record:
    if case == MOVING_WALL:
        return press_against_wall(rate, between_ticks)
    scenario = load_scenario(
        case,
        (POINT if case == AVOIDANCE else {})
        | {
            "period": 1.0 / rate,
            "between_ticks": between_ticks,
            "infeasible": "least_violation",
            "integrator": {"max_step": min(_STEP, 1.0 / rate)},
        },
    )
    return simulate(scenario, step_time=False).summary


def _table(
    about: str, kinds: Sequence[tuple[float, str]], found: Sequence[Record]
) -> str:
    columns = {
        name: column
        for name, column in _COLUMNS.items()
        if any(each.get(name) is not None for each in found)
    }
    return table(
        about,
        ["rate [Hz]", "`between_ticks`", *(title for title, _ in columns.values())],
        [
            [
                f"{rate:g}",
                setting,
                *(_cell(each[name], form) for name, (_, form) in columns.items()),
            ]
            for (rate, setting), each in zip(kinds, found, strict=True)
        ],
    )


def _cell(value: float | None, form: str) -> str:
    if value is None:
        return "–"
    return rounded_down(value) if form == "down" else format(value, form)


if __name__ == "__main__":
    for part in sweep():
        print(part)
        print(part.split("\n", 1)[0], file=sys.stderr)
