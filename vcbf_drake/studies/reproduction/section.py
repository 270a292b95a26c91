"""Section: one part of the reproduction, and what its parts are made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from vcbf_drake.simulation.loading import merge_overrides
from vcbf_drake.studies.reproduction.archive import Archive
from vcbf_drake.studies.trial import Record, Trial

Overrides = Mapping[str, Any]
Records = Mapping[str, Sequence[Record]]


@dataclass(frozen=True)
class Section:
    """What to run for a figure or a table, and what it says.

    Attributes:
        name: Its key in the results.
        evaluate: Returns its part of the results, from the archive, which holds the
            runs, and the records of each of its studies.
        runs: Single runs that are kept whole, by their places below ``runs/``.
        studies: Trials of which only the records are kept, by the names of their files.
    """

    name: str
    evaluate: Callable[[Archive, Records], Record]
    runs: Mapping[str, Trial] = field(default_factory=dict)
    studies: Mapping[str, Sequence[Trial]] = field(default_factory=dict)

    @property
    def cost(self) -> int:
        """How many runs it takes."""
        return len(self.runs) + sum(map(len, self.studies.values()))


def text(overrides: Overrides) -> str:
    """Returns overrides as trials take them: one line of YAML, empty for none."""
    return merge_overrides(overrides) if overrides else ""


def runs_under(
    methods: Sequence[str], scenario: str, key: str, overrides: Overrides | None = None
) -> dict[str, Trial]:
    """Returns a scenario's runs under several methods, by their places ``KEY/METHOD``.

    Args:
        methods: The safety filters.
        scenario: A shipped scenario's name.
        key: Their common place.
        overrides: Values that replace the scenario's.
    """
    return {
        f"{key}/{method}": Trial(scenario, method, 0, overrides=text(overrides or {}))
        for method in methods
    }


def entries(archive: Archive, runs: Mapping[str, Trial], key: str) -> dict[str, Record]:
    """Returns what the results say of the runs below a key, by method.

    Args:
        archive: Holds the runs.
        runs: All runs of the section.
        key: The common place of those wanted.
    """
    return {
        trial.method: {
            "run": f"runs/{place}",
            "summary": archive.summary(place),
            "command": trial.command(),
        }
        for place, trial in runs.items()
        if place.rpartition("/")[0] == key
    }
