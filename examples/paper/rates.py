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
# From 20 Hz to 1 kHz

Made by `python -m examples.paper.rates`.

The rows of the filter hold at the ticks; the input is held in between. Each case runs
at every rate twice: with `between_ticks: none`, and with `between_ticks: certified`,
which asks for inputs under which the rows hold until the next tick (E88). All runs have
the method dob-vcbf-qp, and the input of least violation where no input is safe.

*Least h seen* is over steps of 1 ms at most. *Certified* is what h was nowhere below,
no instant left out, whatever the disturbance did within what was known of it at the
ticks (E87). The labels are those of [theory.md](../theory.md).
"""

_ABOUT = {
    MOVING_WALL: """\
A car is pressed, with all it has, against a wall that moves to and fro, 0.5 m to
either side at 2 rad/s; h is its distance [m]. The row is active at every tick, and its
right-hand side moves on as soon as the tick is over. The observer has to find a
constant push of 0.2 m/s^2; as it does not change, the hold's margin (E28) is 0 and
hides nothing. *Median h* is what the margin costs: the distance that the car keeps.""",
    "car-avoidance": """\
The shipped scenario, its car a point; h in m^2. Its obstacle is round and stands still,
and a car that goes straight on moves away from it: little is lost between ticks, little
is asked.""",
    "blimp-single-obstacle": """\
The shipped scenario; h in m. The wind, which reverses, presses the blimp onto a sphere.
At 20 Hz its yaw and speed change much within a period, and h is kept larger; from 50 Hz
on the margin costs a millimetre, from 100 Hz on nothing that could be seen.""",
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
