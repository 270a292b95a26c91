"""Why the clearances of Test 1 differ: the closed form beside what was measured."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vcbf_drake.viz.report.document import (
    Block,
    Column,
    Paragraph,
    Table,
    number_columns,
)
from vcbf_drake.viz.report.reproduction import in_drawing_order
from vcbf_drake.viz.report.wording import between, fixed, method_label


def clearances(numbers: Mapping[str, Any]) -> list[Block]:
    """The reading in words, and what it says of every method beside the run."""
    rows = in_drawing_order({row["method"]: row for row in numbers["rows"]})
    return [
        Paragraph(numbers["text"]),
        Table(
            "The clearances in the reversing wind, in closed form and as they were.",
            [
                Column("method", whole=True),
                Column("quasi-static clearance"),
                *number_columns("from, to [m]", "integrated [m]", "least *h* [m]"),
            ],
            [
                [
                    method_label(method),
                    row["law"],
                    between([row["least"], row["greatest"]], 3),
                    fixed(row["integrated"], 3),
                    fixed(row["measured"], 3),
                ]
                for method, row in rows.items()
            ],
        ),
    ]
