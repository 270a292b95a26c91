"""What commands write: directories that are whole or not there, and plain JSON."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import math
import os
from pathlib import Path
import shutil
import tempfile
from typing import Any


@contextmanager
def whole_or_not_at_all(directory: Path) -> Iterator[Path]:
    """Yields an empty directory whose files move to `directory` when all went well.

    Files of the same name are replaced; others stay.
    """
    directory.parent.mkdir(parents=True, exist_ok=True)
    room = Path(tempfile.mkdtemp(dir=directory.parent, prefix=f".{directory.name}-"))
    try:
        staging = room / "results"
        staging.mkdir()
        yield staging
        for path in [path for path in staging.rglob("*") if path.is_file()]:
            target = directory / path.relative_to(staging)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, target)
    finally:
        shutil.rmtree(room, ignore_errors=True)


def plain_json(value: Any) -> Any:
    """Returns the value with None for what JSON has no number for."""
    if isinstance(value, dict):
        return {key: plain_json(item) for key, item in value.items()}
    if isinstance(value, list):
        return [plain_json(item) for item in value]
    finite = not isinstance(value, float) or math.isfinite(value)
    return value if finite else None
