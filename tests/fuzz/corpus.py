"""Runs a fuzz target from seeds, in a temporary corpus that it may grow."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
import sys
import tempfile

import atheris


def run(
    target: Callable[[bytes], None], seeds: Iterable[bytes], words: Iterable[str]
) -> None:
    """Feeds the target until it fails or libFuzzer's limits are reached.

    Args:
        target: Must not raise.
        seeds: Inputs to start from.
        words: What inputs are likely to hold.
    """
    with tempfile.TemporaryDirectory() as name:
        corpus = Path(name) / "corpus"
        corpus.mkdir()
        for number, seed in enumerate(seeds):
            (corpus / str(number)).write_bytes(seed)
        dictionary = Path(name) / "words"
        escaped = (f'"{word}"\n' for word in words)
        dictionary.write_text("".join(escaped), encoding="ascii")
        limits = ["-timeout=60", "-rss_limit_mb=3000", f"-dict={dictionary}"]
        given = sys.argv[1:]
        alone = any(not argument.startswith("-") for argument in given)
        atheris.Setup(
            [sys.argv[0], *limits, *given, *([] if alone else [str(corpus)])], target
        )
        atheris.Fuzz()
