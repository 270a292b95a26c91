"""Links between the documents: every page is there, and is reached from the index."""

from pathlib import Path
import re

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    path
    for folder in (".", "docs", "docs/guide", "docs/results", "examples", "diagrams")
    for path in (ROOT / folder).glob("*.md")
)


def targets(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    found = re.findall(r"\]\(([^)\s]+)\)", text)
    return [each.partition("#")[0] for each in found if "://" not in each]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_somewhere(page):
    for target in filter(None, targets(page)):
        assert (page.parent / target).exists(), target


def test_the_index_leads_to_every_page_of_docs():
    index = ROOT / "docs" / "index.md"
    reached = {(index.parent / each).resolve() for each in targets(index)}
    pages = {page for page in PAGES if "docs" in page.parts and page != index}
    assert pages <= reached


def test_the_readme_fits_a_few_screens():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120
