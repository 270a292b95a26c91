"""LogFiles: arrays that grow on disk and can be read at any time."""

from __future__ import annotations

from collections.abc import Mapping
import os
from pathlib import Path

import numpy as np

from vcbf_drake.checks import Array


class LogFiles:
    """Named arrays in a directory, one .npy file each, that grow by whole pieces.

    A piece's numbers are written before the header that counts them, so each file is a
    readable array whenever the writing stops.
    """

    def __init__(self, directory: str | Path) -> None:
        """Makes the directory and empties it of arrays.

        Args:
            directory: Where the files go.
        """
        self._directory = Path(directory)
        self._directory.mkdir(parents=True, exist_ok=True)
        for path in self._directory.glob("*.npy"):
            path.unlink()
        self._lengths: dict[str, int] = {}

    def append(self, arrays: Mapping[str, Array]) -> None:
        """Adds a piece to each array's end; the pieces differ in their first axis only.

        Args:
            arrays: Of the same names every time.
        """
        for name, values in arrays.items():
            piece, path = np.ascontiguousarray(values), self._path(name)
            before = self._lengths.get(name, 0)
            self._lengths[name] = before + len(piece)
            if not before:
                np.save(path, piece)
                continue
            # Of fixed length: NumPy leaves room for the count to grow.
            header = np.lib.format.header_data_from_array_1_0(piece)
            header["shape"] = (before + len(piece), *piece.shape[1:])
            with path.open("r+b") as file:
                file.seek(0, os.SEEK_END)
                file.write(piece.tobytes())
                file.flush()
                file.seek(0)
                np.lib.format.write_array_header_1_0(file, header)

    def _path(self, name: str) -> Path:
        return self._directory / f"{name}.npy"

    def arrays(self) -> dict[str, Array]:
        """Returns the arrays, mapped from the files rather than read."""
        return read_log_files(self._directory)


def read_log_files(directory: str | Path) -> dict[str, Array]:
    """Returns the arrays that `LogFiles` has written so far, equally long each.

    Args:
        directory: Where the files are.

    Raises:
        FileNotFoundError: There are none.
    """
    paths = sorted(Path(directory).glob("*.npy"))
    if not paths:
        raise FileNotFoundError(f"{directory}: no arrays of a log there")
    arrays = {path.stem: np.load(path, mmap_mode="r") for path in paths}
    whole = min(map(len, arrays.values()))  # The last piece may be in some files only.
    return {name: array[:whole] for name, array in arrays.items()}
