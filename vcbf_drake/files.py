"""Files and directories that are written whole or not at all, and plain JSON."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import Field
import json
import math
import os
from pathlib import Path
import queue
import shutil
from threading import Thread
from types import MappingProxyType
from typing import Any, BinaryIO, Generic, TypeVar

_T = TypeVar("_T")

# The metadata of a dataclass's field that names a file: ``field(metadata=IS_FILE)``. In
# a scenario file its path is relative to that file.
IS_FILE = MappingProxyType({"is_file": True})


def names_file(field: Field[Any]) -> bool:
    """Returns whether a dataclass's field names a file."""
    return "is_file" in field.metadata


def resolved(name: str, directory: Path) -> str:
    """Returns a file's name as a whole path.

    Args:
        name: Relative to the directory or not; a URL (``package://...``) and nothing
            stay what they are.
        directory: The directory.
    """
    if not name or "://" in name:
        return name
    return str((directory / Path(name).expanduser()).resolve())


def read_text(path: Path) -> str:
    """Returns the content of a text file.

    Raises:
        ScenarioError: It cannot be read.
    """
    from vcbf_drake.errors import ScenarioError  # It brings NumPy, and --help is quick.

    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ScenarioError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ScenarioError(f"{path}: not a UTF-8 text file") from None


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Opens a file that replaces the path when it is complete.

    Args:
        path: Its directory exists.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("wb") as file:
            yield file
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def atomic_write(path: Path, content: str | bytes) -> None:
    """Writes a whole file, text as UTF-8, or leaves it as it was.

    Args:
        path: Its directory exists.
        content: The whole content.
    """
    with replacing(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


@contextmanager
def whole_directory(directory: Path) -> Iterator[Path]:
    """Yields an empty directory whose files move to `directory` when all went well.

    Files of the same name are replaced; others stay. What a killed process left beside
    the directory is removed.

    Args:
        directory: It is made when it is needed.
    """
    parent, prefix = directory.parent, f".{directory.name}-"
    parent.mkdir(parents=True, exist_ok=True)
    for left in parent.glob(f"{prefix}*"):
        owner = left.name.removeprefix(prefix)
        if owner.isdigit() and not _is_alive(int(owner)):
            shutil.rmtree(left, ignore_errors=True)
    staging = parent / f"{prefix}{os.getpid()}"
    staging.mkdir()
    try:
        yield staging
        for path in [path for path in staging.rglob("*") if path.is_file()]:
            target = directory / path.relative_to(staging)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, target)
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def json_text(value: Any, indent: int | None = 2) -> str:
    """Returns JSON, a line break after it, with null for nan and infinity.

    Args:
        value: Dictionaries, lists, tuples, texts and numbers.
        indent: The indentation of inner lines; None for one line.
    """
    return json.dumps(_plain(value), indent=indent, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    finite = not isinstance(value, float) or math.isfinite(value)
    return value if finite else None


class WriterThread(Generic[_T]):
    """A thread that writes items, so that a slow reader does not stop the program.

    Args:
        write: Called with one item after the other, in that thread.
        capacity: The number of items that may wait.
        patience: The time for which `close` waits for the last one [s].
        end: Called after it, in that thread.

    Attributes:
        lost: The number of items that found no room.
    """

    def __init__(
        self,
        write: Callable[[_T], object],
        capacity: int,
        patience: float,
        end: Callable[[], object] = lambda: None,
    ) -> None:
        self.lost = 0
        self._write, self._end, self._patience = write, end, patience
        self._queue: queue.Queue[_T | None] = queue.Queue(capacity)
        self._closing = False
        self._thread = Thread(target=self._work, daemon=True)
        self._thread.start()

    @property
    def is_open(self) -> bool:
        """Whether items wait to be written, or the writer is not closed."""
        return self._thread.is_alive()

    def __call__(self, item: _T) -> None:
        """Queues an item, or counts it as lost."""
        try:
            self._queue.put_nowait(item)
        except queue.Full:
            self.lost += 1

    def close(self) -> None:
        """Writes the waiting items within the time limit."""
        self._closing = True
        with suppress(queue.Full):
            self._queue.put_nowait(None)  # Wakes the thread.
        self._thread.join(self._patience)
        if self._thread.is_alive():
            self.lost += self._queue.qsize()

    def _work(self) -> None:
        while not (self._closing and self._queue.empty()):
            item = self._queue.get()
            if item is not None:
                self._write(item)
        self._end()
