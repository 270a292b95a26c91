"""Summaries of studies: running times with their intervals, and pairs compared."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from vcbf_drake.studies.trial import Record, Trial

Interval = tuple[float, float]

_CONFIDENCE = 0.95


def summarise_study(trials: Sequence[Trial], records: Sequence[Record]) -> Record:
    """Compares the methods of a study, every one with the first.

    Args:
        trials: The trials, those of one method differing by their index.
        records: Their records, in the same order.

    Returns:
        A dict that JSON can hold:
        ``methods``: for each method its ``trials``, its ``outcomes`` with their counts,
        its ``mean_running_time`` [s] and the 95 % confidence ``interval`` of that, the
        ``median_arrival`` of those that reached the target [s], and the least h and V_v
        of all, ``least_barrier`` and ``least_volume``.
        ``comparisons``: for each method but the first, over the pairs in which neither
        trial crashed, the ``mean_difference`` of the running times [s], positive when
        the method ran longer, its ``interval``, and in how many pairs it did
        ``better``, the ``same`` or ``worse``: first who collides, then who runs
        shorter, then who does not arrive. ``worse_trials`` lists the last with the
        commands that run them again.
        ``errors``: the trials that crashed, with those commands.
    """
    methods = list(dict.fromkeys(trial.method for trial in trials))
    return {
        "methods": {
            name: summarise_method(name, records)
            | {"median_arrival": _median_arrival(name, records)}
            for name in methods
        },
        "comparisons": [
            _compare(methods[0], name, trials, records) for name in methods[1:]
        ],
        "errors": [
            {
                "index": trial.index,
                "method": trial.method,
                "error": record["error"],
                "replay": trial.command(),
            }
            for trial, record in zip(trials, records, strict=True)
            if record["error"] is not None
        ],
    }


def mean_interval(values: Sequence[float]) -> Interval | None:
    """Returns the 95 % confidence interval of a mean, by a seeded bootstrap.

    Percentiles of resampled means assume no distribution; running times pile up at the
    run's duration. Few or equal values make the interval too short. None for fewer
    than two values.
    """
    if len(values) < 2:
        return None
    from scipy.stats import bootstrap  # Half a second, and only a summary needs it.

    found = bootstrap(
        (np.asarray(values),),
        np.mean,
        method="percentile",
        confidence_level=_CONFIDENCE,
        n_resamples=10_000,
        batch=100,  # They fit in memory.
        rng=np.random.default_rng(0),
    ).confidence_interval
    return float(found.low), float(found.high)


def share_interval(count: int, total: int) -> Interval | None:
    """Returns Wilson's 95 % confidence interval of a share, None for a total of 0."""
    if total == 0:
        return None
    from scipy.stats import binomtest

    found = binomtest(count, total).proportion_ci(_CONFIDENCE, method="wilson")
    return float(found.low), float(found.high)


def summarise_method(method: str, records: Sequence[Record]) -> Record:
    """Returns a method's part of `summarise_study`."""
    own = [record for record in records if record["method"] == method]
    ended = [record for record in own if record["error"] is None]
    times = [record["running_time"] for record in ended]
    barriers = [r["min_barrier"] for r in ended if r["min_barrier"] is not None]
    volumes = [r["min_volume"] for r in ended if r["min_volume"] is not None]
    return {
        "trials": len(own),
        "outcomes": dict(sorted(Counter(r["outcome"] for r in own).items())),
        "mean_running_time": _mean(times),
        "interval": mean_interval(times),
        "least_barrier": min(barriers, default=None),
        "least_volume": min(volumes, default=None),
    }


def _median_arrival(method: str, records: Sequence[Record]) -> float | None:
    own = [record for record in records if record["method"] == method]
    arrivals = [r["reached_at"] for r in own if r["outcome"] == "reached"]
    return float(np.median(arrivals)) if arrivals else None


def _compare(
    baseline: str, method: str, trials: Sequence[Trial], records: Sequence[Record]
) -> Record:
    bases = {r["index"]: r for r in records if r["method"] == baseline}
    pairs = [
        (trial, own, base)
        for trial, own in zip(trials, records, strict=True)
        if trial.method == method and (base := bases.get(trial.index)) is not None
        if own["error"] is None and base["error"] is None
    ]
    differences = [own["running_time"] - base["running_time"] for _, own, base in pairs]
    merits = [(_merit(own), _merit(base)) for _, own, base in pairs]
    worse = [
        {
            "index": trial.index,
            "outcome": own["outcome"],
            "running_time": own["running_time"],
            "baseline_outcome": base["outcome"],
            "baseline_running_time": base["running_time"],
            "replay": trial.command(),
        }
        for trial, own, base in pairs
        if _merit(own) < _merit(base)
    ]
    return {
        "method": method,
        "baseline": baseline,
        "pairs": len(pairs),
        "mean_difference": _mean(differences),
        "interval": mean_interval(differences),
        "better": sum(own > base for own, base in merits),
        "same": sum(own == base for own, base in merits),
        "worse": len(worse),
        "worse_trials": worse,
    }


def _merit(record: Record) -> tuple[bool, float, bool]:
    outcome = record["outcome"]
    return outcome != "collision", record["running_time"], outcome == "reached"


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None
