"""Figure 1: one sphere and a reversing wind."""

from __future__ import annotations

from vcbf_drake.studies.reproduction.judgements.finding import Data, Finding
from vcbf_drake.studies.reproduction.judgements.numbers import (
    arrives,
    collides,
    summary_of,
)
from vcbf_drake.studies.reproduction.judgements.words import arrival, listed, safety
from vcbf_drake.studies.reproduction.shares import WITH, WITHOUT, failed

WANG_XU, ROBUST, NOMINAL = "wang-xu-dob-cbf-qp", "robust-cbf-qp", "cbf-qp"

# An estimate is called accurate when its error is below this share of the disturbance.
_ACCURATE = 0.02


def nominal_collides(data: Data) -> Finding:
    """Figure 1(a): the nominal filter does not stay safe."""
    main = summary_of(data["test_1"]["runs"], NOMINAL)
    steady = _steady(data, NOMINAL)
    return Finding(
        collides(main),
        all(map(collides, steady)),
        f"{safety(main)}; in steady winds {listed(map(safety, steady))}",
    )


def others_arrive(data: Data) -> Finding:
    """Figure 1(a): the three others go round the sphere and arrive."""
    methods = (WITH, WANG_XU, ROBUST)
    main = [summary_of(data["test_1"]["runs"], method) for method in methods]
    steady = [summary for method in methods for summary in _steady(data, method)]
    arrivals = listed(
        f"{method} {arrival(s)}" for method, s in zip(methods, main, strict=True)
    )
    safe = sum(not failed(summary) for summary in steady)
    return Finding(
        all(map(arrives, main)),
        all(map(arrives, steady)),
        f"{arrivals}; in steady winds {sum(map(arrives, steady))} of {len(steady)}"
        f" runs arrive within the time and {safe} stay safe",
    )


def proposed_is_closest(data: Data) -> Finding:
    """Figure 1(b): the proposed filter has the least h of the safe ones, above 0."""

    def is_closest(runs: Data) -> bool:
        others = (_height(runs, WANG_XU), _height(runs, ROBUST))
        return 0.0 < _height(runs, WITH) < min(others)

    def heights(runs: Data, *methods: str) -> str:
        return listed(f"{m} {_height(runs, m):.3f} m" for m in methods)

    main, winds = data["test_1"]["runs"], data["test_1"]["steady_winds"]
    beside = [heights(wind["runs"], WITH, WANG_XU, ROBUST) for wind in winds]
    return Finding(
        is_closest(main),
        all(is_closest(wind["runs"]) for wind in winds),
        f"least h: {heights(main, WITH, WANG_XU, ROBUST, WITHOUT)}; in steady winds"
        f" {'; '.join(beside)}",
    )


def estimate_is_accurate(data: Data) -> Finding:
    """Figure 1(c): the RISE observer's estimate is accurate."""
    main = _relative_error(data["test_1"]["estimation"])
    number = f"error after 1 s at most {main:.2%} of the greatest disturbance"
    explicit = data.get("test_2_explicit")
    if explicit is None:
        return Finding(main < _ACCURATE, True, number)
    beside = _relative_error(explicit["explicit"]["estimation"])
    rate = explicit["observer_rate"]
    return Finding(
        main < _ACCURATE,
        beside < _ACCURATE,
        f"{number}; with the explicit step at {rate:.0f} Hz, in another wind,"
        f" {beside:.0%}",
    )


def error_bound_holds(data: Data) -> Finding:
    """Lemma 2: the error is below delta1 exp(-lambda_V t / 2) for all time."""
    estimations = [data["test_1"]["estimation"], data["test_2"]["estimation"]]
    printed = [each["above_printed_bound"] for each in estimations]
    certified = [each["above_certified_bound"] for each in estimations]
    return Finding(
        max(printed) == 0.0,
        True,
        f"exceeded at {printed[0]:.0%} and {printed[1]:.0%} of the ticks of Tests 1 and"
        f" 2; the bound certified for sampled time at {certified[0]:.0%} and"
        f" {certified[1]:.0%}",
    )


def _steady(data: Data, method: str) -> list[Data]:
    winds = data["test_1"]["steady_winds"]
    return [summary_of(wind["runs"], method) for wind in winds]


def _height(runs: Data, method: str) -> float:
    return float(summary_of(runs, method)["min_barrier"])


def _relative_error(estimation: Data) -> float:
    return float(estimation["greatest_error"] / estimation["greatest_disturbance"])
