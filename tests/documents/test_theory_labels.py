from pathlib import Path
import re

import pytest

ROOT = Path(__file__).parents[2]
THEORY = (ROOT / "docs/theory.md").read_text(encoding="utf-8")
ANCHORS = re.findall(r'<a id="([^"]+)"></a>', THEORY)


def labels_in_parentheses(text):
    """Labels as docstrings cite them: (E54), (R39 - R41), (E60, E62)."""
    groups = re.findall(r"\(([ERB]\d+\b[^()]*)\)", text)
    return {label for group in groups for label in re.findall(r"\b[ERB]\d+\b", group)}


CITED = {
    (str(path.relative_to(ROOT)), label)
    for path in sorted((ROOT / "vcbf_drake").rglob("*.py"))
    for label in labels_in_parentheses(path.read_text(encoding="utf-8"))
}


def test_the_search_for_labels_finds_them():
    found = labels_in_parentheses("(E54) (R39 - R41), (E60, E62) (B2), E17 (E x)")
    assert found == {"E54", "R39", "R41", "E60", "E62", "B2"}
    assert ("vcbf_drake/safety/settings.py", "B2") in CITED


@pytest.mark.parametrize(("path", "label"), sorted(CITED))
def test_every_label_the_code_cites_is_in_the_theory(path, label):
    assert label.lower() in ANCHORS, f"{path} cites ({label})"


def test_every_equation_has_one_anchor_and_one_tag():
    tags = re.findall(r"\\tag\{(E\d+)\}", THEORY)
    equations = [anchor for anchor in ANCHORS if re.fullmatch(r"e\d+", anchor)]
    assert sorted(equations) == sorted({tag.lower() for tag in tags})
    assert len(tags) == len(equations) and len(ANCHORS) == len(set(ANCHORS))


def test_every_link_within_the_theory_resolves():
    headings = {
        re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-")
        for heading in re.findall(r"^#+ (.*)$", THEORY, flags=re.MULTILINE)
    }
    links = set(re.findall(r"\]\(#([^)]+)\)", THEORY))
    assert links <= headings | set(ANCHORS)
