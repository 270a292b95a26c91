"""A search for random courses that can be flown only with the volume barrier.

Flies random courses without and with the volume barrier. The courses on which only the
second one arrives, without slack, are flown again from the random starts of the paper's
Table I and listed by how often the outcome is the same. The shipped scenario
`blimp-multiple-obstacles` is course 5, the head of that list.

    python examples/search_layouts.py --layouts 600 --workers 2

Records go to JSON-lines files, one line a flight; an interrupted search resumes.
"""

import argparse
from pathlib import Path

from paper.blimp_courses import BLIMP_COURSES, blimp_course
from paper.table_1 import RANDOM_STARTS

from vcbf_drake.simulation.loading import merge_overrides
from vcbf_drake.studies import Record, Trial, run_study

SCENARIO = "blimp-multiple-obstacles"
METHODS = ("dob-cbf-qp", "dob-vcbf-qp")
STARTS = 10  # random starts from which a rescued course is flown again


def pairs(records: list[Record]) -> list[tuple[Record, Record]]:
    """Returns the records without and with the volume barrier, in pairs."""
    return list(zip(records[::2], records[1::2], strict=True))


def is_rescued(without: Record, with_volume: Record) -> bool:
    """Whether only the volume barrier arrives, and without slack."""
    return (
        without["outcome"] == "infeasible"
        and with_volume["outcome"] == "reached"
        and with_volume["max_abs_slack"] == 0.0
    )


def starts_on(course: int) -> list[Trial]:
    """Returns trials on one course from random starts."""
    overrides = merge_overrides(blimp_course(course))
    return [
        Trial(SCENARIO, method, start, 0, RANDOM_STARTS, overrides)
        for start in range(STARTS)
        for method in METHODS
    ]


def main() -> None:
    """Runs what of the search has not been run, then reports on all of it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--layouts", type=int, default=600, help="how many courses")
    parser.add_argument("--workers", type=int, default=2, help="how many processes")
    parser.add_argument(
        "--out", type=Path, default=Path("out/search_layouts"), help="results"
    )
    parser.add_argument("--short", action="store_true", help="2 courses, for a check")
    arguments = parser.parse_args()
    count, workers = arguments.layouts, arguments.workers
    if arguments.short:
        count, workers = 2, 1
    courses = [
        Trial(SCENARIO, method, index, variation=BLIMP_COURSES)
        for index in range(count)
        for method in METHODS
    ]
    flights = pairs(run_study(courses, arguments.out / "courses.jsonl", None, workers))
    rescued = [flight for flight in flights if is_rescued(*flight)]
    print(f"{count} courses, {len(rescued)} of them rescued without slack")
    robust = {}
    for without, _ in rescued:
        path = arguments.out / f"course-{without['index']}.jsonl"
        again = pairs(run_study(starts_on(without["index"]), path, None, workers))
        robust[without["index"]] = sum(is_rescued(*flight) for flight in again)
    print("course  same outcome  infeasible at  arrives at  min V_v  min h")
    for without, with_volume in sorted(rescued, key=lambda f: -robust[f[0]["index"]]):
        print(
            f"{without['index']:>6}{robust[without['index']]:>8} of {STARTS}"
            f"{without['infeasible_at']:>13.2f} s{with_volume['reached_at']:>10.2f} s"
            f"{with_volume['min_volume']:>9.3f}{with_volume['min_barrier']:>7.3f}"
        )


if __name__ == "__main__":
    main()
