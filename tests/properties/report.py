"""The property campaign in words and tables, as Markdown."""

from __future__ import annotations

from collections.abc import Iterator

from tests.properties.campaign import ALL_KINDS, RAISED, PropertyCounts
from tests.properties.decision_check import FEASIBILITY, OPTIMALITY, UNSOLVED
from vcbf_drake.safety import FilterStatus

_PROMISES = {
    RAISED: "an answer for all data",
    "finite": "input and slack are finite",
    "inside": f"the input is inside the input set, to {FEASIBILITY:g}",
    "status": "FAILED if state, rows or reference are not finite",
    "fallback": "FAILED, and policy `hold`: the input nearest to the held one",
    "rows": f"REFERENCE, FILTERED, RELAXED: every row holds, to {FEASIBILITY:g}",
    "reference": "REFERENCE: the reference itself",
    "volume row": "REFERENCE, FILTERED: the volume rows hold too",
    "slack": "the slack is that of the input, and negative only when RELAXED",
    "least slack": "RELAXED: no input has less slack, row by row",
    "optimal": "no input that satisfies the rows is nearer to the reference",
    "conflict": "INFEASIBLE: the named rows exclude each other, no proper subset does",
    "least violation": "INFEASIBLE: no input violates the rows less",
    "decay": "only admissible decay rates grow, as little as the nearest input needs",
}

_INTRODUCTION = f"""\
Random ticks of the filter: rows in general position, through one point, duplicated,
opposite, nearly parallel, with zero coefficients; sets that are empty, nearly empty, as
small as 1e-9 or as far away as 1e8; boxes and polytopes of 1 to 4 inputs, 0 to 8 rows,
in units from 1e-8 to 1e8; references up to 1e12 input ranges away; nan and infinities
anywhere; every policy that depends on the rows alone, both kinds of slack, up to two
volume rows; and the filters of a blimp and a car at random states, under every method.

Every answer is checked by arithmetic that shares no code with the filter and uses no
solver: a point proves that a set is nonempty, multipliers prove that no point is better
or that the set is empty (in rational numbers where floating point is undecided).
Distances are in normalised inputs; *better* means by more than {OPTIMALITY:g} of
the cost's terms."""

_UNSOLVED = """\
The filter may also report that no solver's answer was verified, or that the volume row
could not be computed (FAILED): this breaks no promise, but is no answer either."""


def property_headline(counts: PropertyCounts) -> list[str]:
    """Returns the campaign's main findings, one sentence each.

    Args:
        counts: What `run_properties` returns.
    """
    return [
        f"{counts.examples} random ticks, {counts.failed} broken promises.",
        f"{counts.unsolved} ticks with finite data had no verified answer (FAILED).",
    ]


def property_markdown(counts: PropertyCounts, seed: int, command: str) -> str:
    """Returns the campaign's page.

    Args:
        counts: What `run_properties` returns.
        seed: Of the examples.
        command: The command that makes this page.
    """
    lines = [
        "# The filter's promises on hostile ticks",
        "",
        f"Produced by `{command}` (seed {seed}).",
        "",
        _INTRODUCTION,
        "",
        *(f"* {sentence}" for sentence in property_headline(counts)),
        "",
        _UNSOLVED,
        "",
        "| promise | meaning | broken |",
        "| --- | --- | ---: |",
        *(
            f"| {name} | {text} | {_times(counts, name)} |"
            for name, text in _PROMISES.items()
        ),
        "",
        *_table(counts),
    ]
    if counts.failures:
        lines += ["", "Examples that broke one, by number:", ""]
        lines += [
            f"* {each['number']} ({each['kind']}): {', '.join(each['broken'])}"
            for each in counts.failures[:50]
        ]
    return "\n".join(lines) + "\n"


def _times(counts: PropertyCounts, promise: str) -> int:
    return sum(n for (_, name), n in counts.broken.items() if name == promise)


def _table(counts: PropertyCounts) -> Iterator[str]:
    statuses = [status.name for status in FilterStatus]
    titles = ["ticks", *statuses, "of them with finite data", "promises broken"]
    yield f"| {' | '.join(titles)} |"
    yield f"| --- |{' ---: |' * (len(titles) - 1)}"
    for kind in ALL_KINDS:
        found = [counts.statuses[kind, status] for status in statuses]
        unsolved = counts.broken[kind, UNSOLVED]
        broken = sum(n for (name, _), n in counts.broken.items() if name == kind)
        cells = [kind, *map(str, found), str(unsolved), str(broken - unsolved)]
        yield f"| {' | '.join(cells)} |"
