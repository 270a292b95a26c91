"""What judgements read from the results, and how they compare."""

from __future__ import annotations

from typing import Any

from vcbf_drake.studies.reproduction.judgements.finding import Data


def summary_of(runs: Data, method: str) -> Data:
    """The summary of a method's run."""
    summary: Data = runs[method]["summary"]
    return summary


def collides(summary: Data) -> bool:
    """Whether a run ended in a collision."""
    return bool(summary["outcome"] == "collision")


def arrives(summary: Data) -> bool:
    """Whether a run arrived without touching anything."""
    return bool(summary["outcome"] == "reached" and summary["min_barrier"] > 0.0)


def is_above(interval: Any, other: Any) -> bool | None:
    """Whether the first interval is the higher; None when they overlap."""
    if interval is None or other is None:
        return None
    if interval[0] > other[1]:
        return True
    # Below, or two equal values without any spread: more trials change nothing.
    if interval[1] < other[0] or (*interval, *other) == 4 * (interval[0],):
        return False
    return None


def both(first: bool | None, second: bool | None) -> bool | None:
    """Kleene's "and": one that is false decides."""
    if first is False or second is False:
        return False
    return None if first is None or second is None else True
