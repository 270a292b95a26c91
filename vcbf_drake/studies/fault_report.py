"""The fault campaign in words and tables, as Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from vcbf_drake.simulation.audit import CONDITIONS, PROMISES
from vcbf_drake.studies.fault_campaign import FAULTS

Kind = tuple[str, str, str, str]

_HOW = """\
All kinds share their draws.
At infeasible ticks the input of least violation is applied, so that a run continues
until it collides or its time is over. A run has *recovered* if its last tick was
neither infeasible nor failed and it did not collide."""

_MEANING = """\
A run is *guaranteed* if every hypothesis of `vcbf-drake check` held and the audit,
which knows the true state and disturbance, found every promise below kept at every
tick. It is *inside the assumptions* if the hypotheses held and, during the run, the
conditions of the theorems (*condition* below); the theorems then promise the rest. The
labels are those of [theory.md](../theory.md). [properties.md](properties.md) has the
filter's promises on random hostile data."""

_COLUMNS = {
    "reached": "reached",
    "collisions": "collided",
    "relaxed_share": "relaxed ticks",
    "infeasible_share": "infeasible ticks",
    "failed_share": "failed ticks",
    "runs_with_bad_ticks": "runs with such ticks",
    "recovered": "of them recovered",
    "least_barrier": "least h",
    "guaranteed": "called guaranteed",
}


def headline(summaries: Mapping[Kind, Mapping[str, Any]]) -> list[str]:
    """Returns the campaign's main findings, one sentence each.

    Args:
        summaries: The results of `summarise_faults`, for each kind of trial.
    """

    def total(name: str) -> int:
        return sum(int(each[name]) for each in summaries.values())

    return [
        f"{total('trials')} runs, {total('errors')} ended in an error.",
        f"{total('illegal_inputs')} runs had an input that was not finite or outside"
        " its limits.",
        f"{total('inside_assumptions')} runs were inside the assumptions;"
        f" {total('broken_inside')} of them broke a promise.",
        f"{_guaranteed_under_fault(summaries)} runs under a fault were called"
        " guaranteed.",
    ]


def campaign_markdown(
    summaries: Mapping[Kind, Mapping[str, Any]], trials: int, seed: int, command: str
) -> str:
    """Returns the campaign's page.

    Args:
        summaries: The results of `summarise_faults`, for each kind of trial.
        trials: The number of trials of each kind.
        seed: The seed of the draws.
        command: The command that makes this page.
    """
    lines = [
        "# Faults in the loop",
        "",
        f"Produced by `{command}`: {trials} trials of each fault, method and fidelity,"
        f" from random starts (seed {seed}). {_HOW}",
        "",
        *(f"* {sentence}" for sentence in headline(summaries)),
        "",
        _MEANING,
        "",
        "| checked at every tick | meaning | role |",
        "| --- | --- | --- |",
        *(_row([name, text, _role(name)]) for name, text in PROMISES.items()),
        "",
        "| fault | description |",
        "| --- | --- |",
        *(_row([fault.name, fault.description]) for fault in FAULTS),
    ]
    for scenario in dict.fromkeys(kind[0] for kind in summaries):
        chosen = {kind: each for kind, each in summaries.items() if kind[0] == scenario}
        lines += ["", f"## {scenario}", "", *_table(chosen)]
    return "\n".join(lines) + "\n"


def _table(summaries: Mapping[Kind, Mapping[str, Any]]) -> Iterator[str]:
    titles = ["fault", "method", "fidelity", *_COLUMNS.values()]
    yield _row(titles)
    yield _row(["---"] * 3 + ["---:"] * len(_COLUMNS))
    for (_, *kind), summary in summaries.items():
        yield _row([*kind, *(_cell(name, summary[name]) for name in _COLUMNS)])


def _role(promise: str) -> str:
    return "condition" if promise in CONDITIONS else "promised"


def _row(cells: Sequence[str]) -> str:
    # A bar would end its cell.
    return f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |"


def _cell(name: str, value: float | None) -> str:
    if value is None:
        return "-"
    if name.endswith("_share"):
        return f"{100.0 * value:.1f} %"
    return f"{value:.3f}" if name == "least_barrier" else str(value)


def _guaranteed_under_fault(summaries: Mapping[Kind, Mapping[str, Any]]) -> int:
    return sum(
        int(each["guaranteed"])
        for (_, fault, *_), each in summaries.items()
        if fault != FAULTS[0].name
    )
