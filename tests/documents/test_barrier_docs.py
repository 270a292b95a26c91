"""The page on barriers: its program runs, its links resolve, no class is missing."""

from __future__ import annotations

from pathlib import Path
import re

import numpy as np
import pytest

from vcbf_drake import barriers
from vcbf_drake.barriers import Barrier

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "guide" / "barriers.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, flags=re.DOTALL | re.MULTILINE)


def test_the_blocks_are_one_program_that_runs() -> None:
    assert len(BLOCKS) == PAGE.count("```python") > 9
    names: dict[str, object] = {}
    for block in BLOCKS:
        line = PAGE[: PAGE.index(block)].count("\n")
        # Empty lines in front make a traceback point into the page.
        exec(
            compile("\n" * line + block, str(DOCS / "guide" / "barriers.md"), "exec"),
            names,
        )


def test_every_class_that_makes_barriers_is_in_the_table() -> None:
    makers = [
        name
        for name in barriers.__all__
        if {"barrier", "barriers"} & set(dir(getattr(barriers, name)))
    ]
    assert len(makers) == 11
    for name in makers:
        assert f"| `{name}` |" in PAGE


def test_links_to_the_theory_resolve() -> None:
    theory = (DOCS / "theory.md").read_text(encoding="utf-8")
    links = re.findall(r"\]\(\.\./theory\.md#([^)]+)\)", PAGE)
    assert len(links) >= 4
    for link in links:
        assert f'<a id="{link}"></a>' in theory


@pytest.mark.parametrize(
    ("rates", "peak"), [((2.0, 2.0), 2.0 / np.e), ((2.0, 200.0), 2.0)]
)
def test_what_the_page_says_on_braking(rates, peak) -> None:
    k1, k2 = Barrier(lambda x, t, p: x[0], np.poly(-np.array(rates))[1:]).gains
    # Double integrator at the speed 1; the row binds from h = 1 / l1 + 1 / l2 on.
    step, h, speed, most = 1e-4, 1.0 / rates[0] + 1.0 / rates[1], 1.0, 0.0
    for _ in range(int(3.0 / step)):
        braking = k1 * speed - k2 * h
        most = max(most, braking)
        h, speed = h - step * speed, speed - step * braking
    assert most == pytest.approx(peak, rel=0.06)
    assert h > 0.0
