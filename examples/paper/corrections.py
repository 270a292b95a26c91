"""The corrections of the published method, one by one: what each of them buys."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from vcbf_drake.studies import Draw, Record

from .archive import Archive
from .blimp_courses import BLIMP_COURSES
from .experiment import (
    WITH,
    Experiment,
    Numbers,
    Plan,
    Records,
    Settings,
    describe,
    paired_trials,
    text,
)
from .figures import Row, outcome_figure
from .report import Block, Figure
from .table_1 import RANDOM_STARTS
from .words import trials_table

SCENARIO = "blimp-multiple-obstacles"

# The corrections that are on, by their label.
VARIANTS: dict[str, tuple[str, ...]] = {
    "as printed": (),
    "exact slack": ("exact_slack",),
    "total derivative": ("total_derivative",),
    "error floor": ("error_floor",),
    "exact slack, total derivative": ("exact_slack", "total_derivative"),
    "all three": ("exact_slack", "total_derivative", "error_floor"),
}
DRAWS: dict[str, tuple[str, Draw]] = {
    "starts": ("from random starts on Test 2's course", RANDOM_STARTS),
    "courses": ("over random courses", BLIMP_COURSES),
}


def plan(settings: Settings) -> Plan:
    """Returns sets of corrections, on Test 2's trials and on courses."""
    trials = [
        trial
        for variant in VARIANTS
        for _, draw in DRAWS.values()
        for trial in paired_trials(
            SCENARIO, settings.ablation_trials, draw, _overrides(variant), (WITH,)
        )
    ]

    def evaluate(archive: Archive, records: Records) -> Record:
        found = records["ablation"]
        return {
            name: {variant: _describe(found, variant, draw) for variant in VARIANTS}
            for name, (_, draw) in DRAWS.items()
        }

    return Plan(evaluate, studies={"ablation": trials})


def _describe(records: Sequence[Record], variant: str, draw: Draw) -> Record:
    wanted = _overrides(variant), draw.name
    own = [r for r in records if (r["overrides"], r["variation"]) == wanted]
    return describe(own, WITH)


def _overrides(variant: str) -> str:
    return text({"fidelity": dict.fromkeys(VARIANTS[variant], True)})


def show(numbers: Numbers, archive: Archive) -> Iterator[Block]:
    """Yields every set of corrections, from random starts and over random courses."""
    command = numbers["command"]
    yield (
        "dob-vcbf-qp with single corrections and with several, from Table I's random"
        " starts on Test 2's course, and over the first random courses, where not"
        " every run succeeds."
    )
    for name, (words, _) in DRAWS.items():
        yield Figure(
            f"ablation_{name}",
            "The method with the published equations, with single corrections and with"
            f" all, {words}: how the trials ended, and how long they ran on average.",
            _draw([(label, WITH, trials) for label, trials in numbers[name].items()]),
            command,
        )
        yield trials_table(
            f"The same in numbers, {words}. A slack of 0 is exactly 0.",
            ["corrections"],
            [([label], trials) for label, trials in numbers[name].items()],
            command,
        )


def _draw(rows: list[Row]) -> Callable[[], Any]:
    return lambda: outcome_figure(rows)


EXPERIMENT = Experiment("ablation", "What each correction buys", plan, show)
