"""Meshcat's own page, and the replay's page around it."""

from __future__ import annotations

from collections.abc import Mapping
import html
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vcbf_drake.viz.replay.page_data import Words, overlay_html

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

MESHCAT_TITLE = "<title>Drake MeshCat</title>"
PHONES = '<meta name="viewport" content="width=device-width, initial-scale=1">'


def write_page(page: str, words: Words, data: Mapping[str, Any], path: Path) -> Path:
    """Writes the page of a replay.

    Args:
        page: Meshcat's page with its recording.
        words: What the card says.
        data: What the scripts show.
        path: The file to write; its directory is made.

    Returns:
        The path.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(whole_page(page, words, data).encode("utf-8"))
    return path


def whole_page(page: str, words: Words, data: Mapping[str, Any]) -> str:
    """Returns Meshcat's page with the card, the plots and the player over it."""
    title = f"{PHONES}<title>{html.escape(words.title)} - vcbf_drake</title>"
    head, tail = page.replace(MESHCAT_TITLE, title).rsplit("</body>", 1)
    return f"{head}{overlay_html(words, data)}</body>{tail}"


def private_meshcat() -> Meshcat:
    """A Meshcat that no other machine can see, on any free port, without a word."""
    # Importing Drake takes time that programs without a replay need not spend.
    from pydrake.geometry import Meshcat, MeshcatParams

    params = MeshcatParams()
    params.host, params.port = "127.0.0.1", 0
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.WARNING)  # Its address would help nobody.
    try:
        return Meshcat(params)
    finally:
        logger.setLevel(level)
