"""What records of trials come to: shares with their intervals, extremes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from vcbf_drake.studies.statistics import share_interval, summarise_method
from vcbf_drake.studies.trial import Record

Pair = Mapping[str, Record]

WITH, WITHOUT = "dob-vcbf-qp", "dob-cbf-qp"
FAILED = ("infeasible", "collision")


def share(count: int, total: int) -> Record:
    """Returns a share with Wilson's 95 % interval, as a dict that JSON can hold.

    Args:
        count: In how many.
        total: Of how many.
    """
    return {
        "count": count,
        "of": total,
        "rate": count / total if total else None,
        "interval": share_interval(count, total),
    }


def pairs(records: Sequence[Record]) -> Iterator[Pair]:
    """Yields the records of each draw by method, unless one of its trials crashed."""
    draws: dict[int, dict[str, Record]] = {}
    for record in records:
        draws.setdefault(record["index"], {})[record["method"]] = record
    for pair in draws.values():
        if all(record["error"] is None for record in pair.values()):
            yield pair


def failure_rates(all_pairs: Sequence[Pair]) -> dict[str, Record]:
    """Returns how often each filter fails, and what the volume barrier does about it.

    To fail is to run out of feasible inputs or to collide.

    Args:
        all_pairs: Each with a record of both filters.
    """
    lost = [pair for pair in all_pairs if failed(pair[WITHOUT])]
    kept = [pair for pair in all_pairs if not failed(pair[WITHOUT])]

    def count(among: Sequence[Pair], condition: Callable[[Record], bool]) -> Record:
        return share(sum(condition(pair[WITH]) for pair in among), len(among))

    return {
        "dob-cbf-qp fails": share(len(lost), len(all_pairs)),
        "dob-vcbf-qp fails": count(all_pairs, failed),
        "of its failures, dob-vcbf-qp reaches": count(
            lost, lambda record: record["outcome"] == "reached"
        ),
        "of its failures, dob-vcbf-qp stays feasible": count(
            lost, lambda record: record["outcome"] == "timeout"
        ),
        "of its failures, dob-vcbf-qp fails too": count(lost, failed),
        "of its successes, dob-vcbf-qp fails": count(kept, failed),
    }


def failed(record: Mapping[str, object]) -> bool:
    """Whether a run ran out of feasible inputs or collided."""
    return record["outcome"] in FAILED


def describe(records: Sequence[Record], method: str) -> Record:
    """Returns outcomes, running time and extremes of a method's trials.

    Args:
        records: Those of a study.
        method: The method.
    """
    ended = [r for r in records if r["method"] == method and r["error"] is None]
    return {
        **summarise_method(method, records),
        "least_barrier": _extreme(min, ended, "min_barrier"),
        "least_volume": _extreme(min, ended, "min_volume"),
        "greatest_slack": _extreme(max, ended, "max_abs_slack"),
        "with_slack": share(sum(r["max_abs_slack"] > 0.0 for r in ended), len(ended)),
    }


def _extreme(
    which: Callable[[Sequence[float]], float], records: Sequence[Record], name: str
) -> float | None:
    values = [record[name] for record in records if record[name] is not None]
    return which(values) if values else None
