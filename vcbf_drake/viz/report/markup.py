"""The little Markdown that words in a report may hold, as HTML."""

from __future__ import annotations

import html
import re

_CODE = re.compile(r"`([^`]+)`")
_LINK = re.compile(r"\[([^\]]+)\]\(([^)\s]+)\)")
_EMPHASIS = re.compile(r"\*([^*\s](?:[^*]*[^*\s])?)\*")


def to_html(text: str) -> str:
    """Returns words with `code`, *emphasis* and [links](...) as HTML."""
    # What is between backticks stays as it is: every second part.
    parts = _CODE.split(text)
    parts[::2] = [_prose(part) for part in parts[::2]]
    parts[1::2] = [f"<code>{html.escape(part)}</code>" for part in parts[1::2]]
    return "".join(parts)


def _prose(text: str) -> str:
    escaped = html.escape(text)
    linked = _LINK.sub(r'<a href="\2">\1</a>', escaped)
    # A number and its percent sign stay on one line.
    return _EMPHASIS.sub(r"<em>\1</em>", linked).replace(" %", "&nbsp;%")
