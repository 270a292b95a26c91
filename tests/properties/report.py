"""The property campaign in words and tables, as Markdown."""

from __future__ import annotations

from collections.abc import Iterator

from tests.properties.campaign import ALL_KINDS, RAISED, PropertyCounts
from tests.properties.decision_check import FEASIBILITY, OPTIMALITY, UNSOLVED
from vcbf_drake.safety import FilterStatus

_PROMISES = {
    RAISED: "an answer, whatever is asked",
    "finite": "input and slack are numbers",
    "inside": f"the input is inside the input set, to {FEASIBILITY:g}",
    "status": "FAILED where state, rows or reference are not numbers",
    "fallback": "then, and with the policy `hold`, the input nearest to the held one",
    "rows": f"REFERENCE, FILTERED, RELAXED: every row is met, to {FEASIBILITY:g}",
    "reference": "REFERENCE: the reference itself",
    "volume row": "not RELAXED: the volume rows are met too",
    "slack": "the slack is that of the input, and below 0 when RELAXED alone",
    "least slack": "RELAXED: no input gives way by less, row by row",
    "optimal": "no input that meets the rows is nearer to the reference",
    "conflict": "INFEASIBLE: the rows named have no common input, any fewer a point",
    "least violation": "INFEASIBLE: no input violates the rows by less",
    "decay": "decay rates grow where they may, by the least that a nearest input asks",
}

_INTRODUCTION = f"""\
Random ticks of the filter: rows in general position, through one point, given twice,
opposite, nearly parallel, with zeros for coefficients; sets that are empty, nearly so,
as small as 1e-9 or as far as 1e8; boxes and polytopes of 1 to 4 inputs, 0 to 8 rows, in
units from 1e-8 to 1e8; references up to 1e12 input ranges away; nan and infinities
anywhere; every policy that asks for nothing but the rows, both slacks, up to two
volume rows; and the filters of a blimp and a car at random states, under every method.

Every answer is checked by arithmetic that shares no code with the filter and asks no
solver: a point proves that there is one, multipliers prove that none is better or that
there is none (in rational numbers where floats leave it open). Distances are in
normalised inputs; *better* means by more than {OPTIMALITY:g} of the cost's terms."""

_UNSOLVED = """\
The filter may also say that no solver's answer was verified, or that the volume row
could not be computed (FAILED): that is no broken promise, but no answer either."""


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
        "# What the filter promises, on hostile ticks",
        "",
        f"Made by `{command}` (seed {seed}).",
        "",
        _INTRODUCTION,
        "",
        *(f"* {sentence}" for sentence in property_headline(counts)),
        "",
        _UNSOLVED,
        "",
        "| promise | what is meant | broken |",
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
    titles = ["ticks", *statuses, "of them finite", "promises broken"]
    yield f"| {' | '.join(titles)} |"
    yield f"| --- |{' ---: |' * (len(titles) - 1)}"
    for kind in ALL_KINDS:
        found = [counts.statuses[kind, status] for status in statuses]
        unsolved = counts.broken[kind, UNSOLVED]
        broken = sum(n for (name, _), n in counts.broken.items() if name == kind)
        cells = [kind, *map(str, found), str(unsolved), str(broken - unsolved)]
        yield f"| {' | '.join(cells)} |"
