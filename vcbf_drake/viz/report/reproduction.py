"""What a reproduction left on disk: its numbers, its runs and its trials."""

from __future__ import annotations

from collections.abc import Mapping
import json
from pathlib import Path
from typing import Any

from vcbf_drake.simulation.result import Result, load_result
from vcbf_drake.viz.runs import Run, label_runs
from vcbf_drake.viz.style import METHOD_STYLES

Numbers = Mapping[str, Any]


def in_drawing_order(entries: Mapping[str, Numbers]) -> dict[str, Numbers]:
    """Entries by method, the method to bring out last."""
    return {method: entries[method] for method in METHOD_STYLES if method in entries}


class Reproduction:
    """A directory that `reproduce` filled; runs are read when they are drawn.

    Args:
        data: The contents of its reproduction.json.
        directory: The directory.
    """

    def __init__(self, data: Numbers, directory: Path) -> None:
        self.data = data
        self._directory = directory
        self._results: dict[str, Result] = {}

    @classmethod
    def read(cls, directory: Path) -> Reproduction:
        """The reproduction in a directory.

        Raises:
            FileNotFoundError: It has no reproduction.json.
        """
        text = (directory / "reproduction.json").read_text(encoding="utf-8")
        return cls(json.loads(text), directory)

    def results(self, runs: Mapping[str, Numbers]) -> list[Result]:
        """The saved results of some runs, the one to bring out last.

        Args:
            runs: For each method an entry that names its directory in ``run``.

        Raises:
            FileNotFoundError: One is missing.
        """
        return [
            self._result(str(entry["run"])) for entry in in_drawing_order(runs).values()
        ]

    def runs(self, runs: Mapping[str, Numbers]) -> list[Run]:
        """The same, ready to be drawn."""
        return label_runs(self.results(runs))

    def records(self, path: str) -> list[dict[str, Any]]:
        """The records of a study's trials.

        Raises:
            FileNotFoundError: The file is missing.
        """
        lines = (self._directory / path).read_text(encoding="utf-8").splitlines()
        return [json.loads(line) for line in lines]

    def _result(self, path: str) -> Result:
        if path not in self._results:
            self._results[path] = load_result(self._directory / path)
        return self._results[path]
