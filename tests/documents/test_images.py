"""The pictures of docs/images: small, shown somewhere, and made by a command."""

from pathlib import Path

from docs.make_images import EXAMPLES, FIGURES, IMAGES, MOST, REPLAYS

ROOT = Path(__file__).parents[2]


def test_every_picture_is_small_shown_and_made() -> None:
    pages = [ROOT / "README.md", ROOT / "examples" / "README.md"]
    text = "".join(page.read_text() for page in [*pages, *ROOT.glob("docs/**/*.md")])
    pictures = sorted(IMAGES.glob("*.png"))
    assert {each.stem for each in pictures} == {*REPLAYS, *FIGURES, *EXAMPLES}
    for picture in pictures:
        assert picture.stat().st_size < MOST, picture
        assert f"images/{picture.name}" in text, picture
