"""Generated code kept on disk, so that a second start needs no SymPy.

One small file for each set of expressions, in ``$XDG_CACHE_HOME/vcbf_drake`` or
``~/.cache/vcbf_drake``; the environment variable ``VCBF_DRAKE_CACHE`` names another
directory, or is ``off``. Without a place to write to, everything is generated anew.

A file's name is a hash of all that its code depends on: the expressions themselves,
what writes the code, and the Python that runs it. Whatever else a file holds than the
code stored under that name is ignored and replaced: its first line has the name and the
code's checksum. Trusted beyond that is nobody: code from a file is run only if it is
pure arithmetic on floats (see `is_arithmetic`), so the worst that someone with access
to the directory can do is to make it calculate something else.
"""

from __future__ import annotations

from hashlib import sha256
import os
from pathlib import Path
import sys
import tempfile

from vcbf_drake.model.generated_code import is_arithmetic
from vcbf_drake.versions import installed_version

_VARIABLE = "VCBF_DRAKE_CACHE"
_OFF = "off"
# A model's numbers are part of its code: a study of many models makes many files.
_MOST_FILES = 1000


def cache_directory() -> Path | None:
    """Returns where generated code is kept; None for nowhere."""
    chosen = os.environ.get(_VARIABLE)
    if chosen == _OFF:
        return None
    try:
        if chosen:
            return Path(chosen).expanduser()
        base = Path(os.environ.get("XDG_CACHE_HOME", ""))
        return (base if base.is_absolute() else Path.home() / ".cache") / "vcbf_drake"
    except RuntimeError:  # Nobody's home.
        return None


def cache_key(*content: str) -> str:
    """Returns the name for code that depends on this content, in order.

    Args:
        content: Everything the code is made from, its generator's text included.
    """
    tools = *map(installed_version, ("drake", "sympy")), sys.version
    return sha256("\0".join((*tools, *content)).encode()).hexdigest()


def load_code(key: str) -> str | None:
    """Returns the code that was stored under a key, or None."""
    directory = cache_directory()
    if directory is None:
        return None
    try:
        content = _file(directory, key).read_text(encoding="utf-8")
    except (OSError, ValueError):  # Not there, not readable, not text.
        return None
    header, _, code = content.partition("\n")
    return code if header == _header(key, code) and is_arithmetic(code) else None


def store_code(key: str, code: str) -> None:
    """Stores code under a key, whole or not at all, if there is a place for it."""
    directory = cache_directory()
    if directory is None:
        return
    temporary = None
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(dir=directory, prefix=".")
        with open(descriptor, "w", encoding="utf-8", newline="\n") as file:
            file.write(f"{_header(key, code)}\n{code}")
        os.replace(temporary, _file(directory, key))
        _remove_oldest(directory)
    except OSError:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)


def _file(directory: Path, key: str) -> Path:
    return directory / f"{key}.py"


def _header(key: str, code: str) -> str:
    return f"# vcbf_drake {key} {sha256(code.encode()).hexdigest()}"


def _remove_oldest(directory: Path) -> None:
    """Keeps the directory from growing without end."""
    files = list(directory.iterdir())
    if len(files) > _MOST_FILES:
        by_age = sorted(files, key=lambda file: file.stat().st_mtime)
        for file in by_age[: len(files) - _MOST_FILES // 2]:
            file.unlink(missing_ok=True)
