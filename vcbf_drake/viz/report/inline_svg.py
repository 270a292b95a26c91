"""A figure's SVG as a part of a page: smaller, and with names of its own."""

from __future__ import annotations

import re

_DROPPED = re.compile(r"<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->", re.S)
_ROOT = re.compile(r"<svg[^>]*>")
_VIEW_BOX = re.compile(r'viewBox="0 0 ([\d.]+) ([\d.]+)"')
_REFERENCE = re.compile(r'(href="#|url\(#)([^")]+)')
_IDENTIFIER = re.compile(r' id="([^"]*)"')
_PATH = re.compile(r'(?<= d=")[^"]*')
_LONG_NUMBER = re.compile(r"-?\d+\.\d{3,}")

# A figure as wide as a printed page fills the column.
_PIXELS_PER_POINT = 1.19 * 96.0 / 72.0


def inline_svg(text: str, name: str) -> str:
    """Returns matplotlib's SVG for use inside HTML.

    Identifiers that nothing refers to go, the others get the figure's name in front,
    so that figures of one page keep apart; paths keep hundredths of a point.

    Args:
        text: The file's text.
        name: A name that no other figure of the page has.
    """
    body = _DROPPED.sub("", text[text.index("<svg") :]).strip()
    box = _VIEW_BOX.search(body)
    if box is None:
        raise ValueError(f"{name}: the SVG has no viewBox that starts at 0 0")
    width = float(box[1]) * _PIXELS_PER_POINT
    # The caption tells those who cannot see it what is drawn.
    root = f'<svg {box[0]} width="{width:.0f}" aria-hidden="true">'
    body = _ROOT.sub(root, body, count=1)
    used = {match[2] for match in _REFERENCE.finditer(body)}

    def own_name(match: re.Match[str]) -> str:
        return f' id="{name}-{match[1]}"' if match[1] in used else ""

    body = _IDENTIFIER.sub(own_name, body)
    body = _REFERENCE.sub(rf"\1{name}-\2", body)
    body = _PATH.sub(lambda path: _LONG_NUMBER.sub(_rounded, path[0]), body)
    return re.sub(r"\s*\n\s*", "\n", body)


def _rounded(match: re.Match[str]) -> str:
    return f"{float(match[0]):.2f}"
