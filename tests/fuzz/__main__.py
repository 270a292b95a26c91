"""Fuzzes a target: `python -m tests.fuzz TARGET [OPTION OF LIBFUZZER]...`."""

from __future__ import annotations

from pathlib import Path
import sys
import tempfile

import atheris

INSTRUMENTED = ["vcbf_drake.hil", "vcbf_drake.simulation", "yaml"]
with atheris.instrument_imports(include=INSTRUMENTED):
    from tests.fuzz.targets import TARGETS


def main() -> None:
    """Feeds the target until it fails or libFuzzer's limits are reached."""
    name, *given = sys.argv[1:] or [""]
    if name not in TARGETS:
        sys.exit(f"TARGET must be one of {', '.join(TARGETS)}")
    target = TARGETS[name]
    with tempfile.TemporaryDirectory() as folder:
        corpus, words = Path(folder) / "corpus", Path(folder) / "words"
        corpus.mkdir()
        for number, seed in enumerate(target.seeds()):
            (corpus / str(number)).write_bytes(seed)
        escaped = (f'"{word}"\n' for word in target.words())
        words.write_text("".join(escaped), encoding="ascii")
        limits = ["-timeout=60", "-rss_limit_mb=3000", f"-dict={words}"]
        if all(argument.startswith("-") for argument in given):
            given.append(str(corpus))
        atheris.Setup([sys.argv[0], *limits, *given], target.take)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
