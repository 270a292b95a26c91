"""How a finding tells its numbers."""

from __future__ import annotations

from collections.abc import Iterable

from vcbf_drake.studies.reproduction.judgements.finding import Data
from vcbf_drake.studies.reproduction.judgements.numbers import collides


def ending(summary: Data) -> str:
    """How a run ended."""
    return {
        "reached": "arrives at {reached_at:.1f} s",
        "infeasible": "has no feasible input at {infeasible_at:.2f} s",
        "collision": "collides at {collided_at:.1f} s",
        "timeout": "is still on its way after {running_time:.0f} s",
    }[summary["outcome"]].format(**summary)


def arrival(summary: Data) -> str:
    """When a run arrived."""
    reached_at = summary["reached_at"]
    return "never" if reached_at is None else f"{reached_at:.1f} s"


def safety(summary: Data) -> str:
    """How near a run came, or that it collided."""
    if collides(summary):
        return f"collides at {summary['collided_at']:.1f} s"
    return f"least h {summary['min_barrier']:.3f} m"


def least_square(summary: Data) -> str:
    """The least h of a barrier that is a difference of squares."""
    least = round(summary["min_barrier"], 2) + 0.0  # No minus before a zero.
    return f"least h {least:.2f} m²"


def mean_time(running_time: Data) -> str:
    """A mean with its interval."""
    mean, interval = running_time["mean"], running_time["interval"]
    if interval is None:
        return f"{mean:.2f} s"
    return f"{mean:.2f} s ({interval[0]:.2f} to {interval[1]:.2f})"


def proportion(share: Data) -> str:
    """A count out of a total, with its interval."""
    if share["rate"] is None:
        return "none of none"
    interval = ""
    if share.get("interval") is not None:
        low, high = share["interval"]
        interval = f", {100 * low:.0f} to {high:.0%}"
    return f"{share['count']} of {share['of']} ({share['rate']:.0%}{interval})"


def listed(words: Iterable[str]) -> str:
    """Words, one after the other."""
    return ", ".join(words)
