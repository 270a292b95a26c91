"""The page on the filter: its program runs, its links resolve, no status is missing."""

from __future__ import annotations

from pathlib import Path
import re

from vcbf_drake import FilterStatus

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "guide" / "filter.md").read_text(encoding="utf-8")


def test_the_check_of_a_loop_runs_and_finds_nothing_wrong(capsys) -> None:
    (block,) = re.findall(r"^```python\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
    exec(compile(block, "filter.md", "exec"), {})
    printed = capsys.readouterr().out
    # phi_1 = h' + 3 h at x = 0, v = 0.5.
    start = "start inside: end of the rail (high) holds (phi_0 = 1, phi_1 = 2.5)"
    assert start in printed
    assert "does not hold" not in printed


def test_every_status_is_explained() -> None:
    for status in FilterStatus:
        assert f"| {int(status)} `{status.name}` |" in PAGE


def test_links_resolve() -> None:
    theory = (DOCS / "theory.md").read_text(encoding="utf-8")
    for label in re.findall(r"\]\(\.\./theory\.md#([^)]+)\)", PAGE):
        assert f'<a id="{label}"></a>' in theory
    for link in re.findall(r"\]\(([^)#:]+)\)", PAGE):
        assert (DOCS / "guide" / link).exists(), link
