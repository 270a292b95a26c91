"""The verdict on every claim of the paper."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from vcbf_drake.viz.report.document import Block, Column, Paragraph, Table
from vcbf_drake.viz.report.reproduction import Reproduction

VERDICTS = (
    "reproduced",
    "reproduced under stated conditions",
    "undecided",
    "not reproduced",
)


def verdicts(claims: Sequence[Mapping[str, Any]], saved: Reproduction) -> list[Block]:
    """Every claim, what was found, the number and the command; the counts first."""
    found = Counter(claim["found"] for claim in claims)
    counts = [f"{found[verdict]} {verdict}" for verdict in VERDICTS if found[verdict]]
    return [
        Paragraph(
            "This report repeats the experiments of *Robust Safety Critical Control"
            " Under Multiple State and Input Constraints: Volume Control Barrier"
            " Function Method* ([arXiv 2503.13996](https://arxiv.org/abs/2503.13996))"
            " in simulation. The paper prints few of its numbers: layouts, limits and"
            " disturbances that it leaves out are ours and are stated where they"
            f" matter. Of {len(claims)} claims: {', '.join(counts)}."
        ),
        Paragraph(_settings(saved.data.get("settings", {}))),
        Table(
            "The paper's claims in its order: what was found, the number that says so,"
            " and the command that shows it. Reproduced means in the main setting and"
            " in those beside it; under stated conditions, in the main setting only;"
            " undecided, that the 95 % intervals of few trials overlap.",
            [
                Column("claim"),
                Column("in the paper"),
                Column("found"),
                Column("number"),
            ],
            [
                [claim["claim"], claim["where"], claim["found"], claim["number"]]
                for claim in claims
            ],
            notes=[f"`{claim['command']}`" for claim in claims],
        ),
    ]


def _settings(settings: Mapping[str, Any]) -> str:
    """How much was run, with which code."""
    counts = [
        f"{key.replace('_', ' ')}: {value}"
        for key, value in settings.items()
        if isinstance(value, int) and not isinstance(value, bool)
    ]
    code = [f"{name} {each}" for name, each in settings.get("versions", {}).items()]
    if "code" in settings:
        code.append(f"code `{settings['code']}`")
    text = "; ".join(", ".join(part) for part in (counts, code) if part) + "."
    if settings.get("quick"):
        text = f"*A quick run:* few trials, wide intervals. {text}"
    return text
