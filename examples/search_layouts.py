"""How often does a blimp's QP run out of inputs, and does the volume barrier help?

Draws random obstacle courses for `blimp-multiple-obstacles` and flies each without
the volume barrier and, where that ends in an infeasible QP, with it. The rescued
courses are flown again from random starts (Table I, case 1, of the paper) and listed
by how often the outcome stays the same. The shipped course heads that list.

    python examples/search_layouts.py --layouts 600 --workers 2

Results go to a JSON-lines file, one line a course; an interrupted search resumes.
"""

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
import json
import multiprocessing
from pathlib import Path

import numpy as np

from vcbf_drake import load_scenario, simulate
from vcbf_drake.disturbances import Sinusoid
from vcbf_drake.simulation import Scenario
from vcbf_drake.simulation.scenario import InputLimits, Obstacle

TARGET = np.array([14.0, 3.0, 2.5])
STARTS = 10  # random starts from which a rescued course is flown again
YAW_ACCELERATION = 2.5  # [rad/s^2], the limit of the yaw moment


def draw_course(seed: int) -> Scenario:
    """Returns a random course: thrust, reverse thrust, speed caps, 4 to 9 spheres."""
    rng = np.random.default_rng([2024, seed])
    scenario = load_scenario("blimp-multiple-obstacles")
    scenario.name = f"course-{seed}"
    thrust, reverse = rng.uniform(0.5, 1.5), rng.uniform(0.1, 0.5)  # [N/kg], share
    surge_mass, _, heave_mass = scenario.plant.effective_masses
    surge, heave = round(thrust * surge_mass, 4), round(thrust * heave_mass, 4)
    yaw = round(YAW_ACCELERATION * scenario.plant.yaw_inertia, 4)
    scenario.input_set = InputLimits(
        lower=[-round(reverse * surge, 4), -heave, -yaw], upper=[surge, heave, yaw]
    )
    scenario.controller.surge_speed_cap = round(rng.uniform(0.8, 2.0), 2)  # [m/s]
    scenario.controller.height_error_cap = round(rng.uniform(0.3, 0.8), 2)  # [m]
    scenario.disturbance = wind(round(0.1 * thrust, 3))
    scenario.obstacles = draw_spheres(rng, count=rng.integers(4, 10))
    return scenario


def wind(strength: float) -> list[Sinusoid]:
    """Returns a gusty wind that reverses [m/s^2]."""
    return [
        Sinusoid(amplitude=[strength, 0.0, 0.0], frequency=0.8, phase=0.0),
        Sinusoid(
            amplitude=[0.0, round(0.5 * strength, 4), 0.0], frequency=0.8, phase=1.5708
        ),
        Sinusoid(
            amplitude=[0.0, 0.0, round(0.8 * strength, 4)], frequency=1.1, phase=0.5
        ),
    ]


def draw_spheres(rng: np.random.Generator, count: int) -> list[Obstacle]:
    """Returns spheres scattered about the straight line to the target."""
    spheres: list[Obstacle] = []
    while len(spheres) < count:
        center = rng.uniform(0.2, 0.85) * TARGET + rng.normal(0.0, [0.2, 0.7, 0.5])
        radius = rng.uniform(0.5, 1.0)
        from_start, from_target = np.linalg.norm([center, center - TARGET], axis=1)
        if from_start > radius + 1.5 and from_target > radius + 1.2:
            spheres.append(
                Obstacle(center=center.round(2).tolist(), radius=round(radius, 2))
            )
    return spheres


def fly(scenario: Scenario, method: str) -> dict:
    """Returns the summary of one flight, without what is not needed here."""
    scenario.method = method
    summary = simulate(scenario).summary
    keys = ("outcome", "running_time", "min_barrier", "min_volume", "max_abs_slack")
    return {key: summary[key] for key in keys}


def try_course(seed: int) -> dict:
    """Flies one course without and, if that fails, with the volume barrier."""
    course = draw_course(seed)
    record = {"seed": seed, "dob-cbf-qp": fly(course, "dob-cbf-qp")}
    if record["dob-cbf-qp"]["outcome"] == "infeasible":
        rescued = record["dob-vcbf-qp"] = fly(course, "dob-vcbf-qp")
        if rescued["outcome"] == "reached" and rescued["max_abs_slack"] == 0.0:
            record["starts"] = [try_start(seed, start) for start in range(STARTS)]
    return record


def try_start(seed: int, start: int) -> dict:
    """Flies a course from a random start of Table I, case 1, both ways."""
    course = draw_course(seed)
    rng = np.random.default_rng([2025, start])
    course.initial_state[:3] = rng.uniform([-0.1, -0.1, 0.0], [0.1, 0.1, 0.2])
    return {m: fly(course, m) for m in ("dob-cbf-qp", "dob-vcbf-qp")}


def same_outcome(record: dict) -> int:
    """Returns from how many starts only the volume barrier arrives, without slack."""
    return sum(
        flights["dob-cbf-qp"]["outcome"] == "infeasible"
        and flights["dob-vcbf-qp"]["outcome"] == "reached"
        and flights["dob-vcbf-qp"]["max_abs_slack"] == 0.0
        for flights in record.get("starts", [])
    )


def report(records: list[dict]) -> None:
    """Prints how often what happened, then the courses worth shipping."""
    failed = [r for r in records if "dob-vcbf-qp" in r]
    print(f"{len(records)} courses; dob-cbf-qp:")
    for outcome, count in Counter(r["dob-cbf-qp"]["outcome"] for r in records).items():
        print(f"  {outcome:<12}{count:>5}")
    print(f"of the {len(failed)} infeasible ones, dob-vcbf-qp:")
    for outcome, count in Counter(r["dob-vcbf-qp"]["outcome"] for r in failed).items():
        print(f"  {outcome:<12}{count:>5}")
    print("rescued without slack, best first:")
    print("  seed  same outcome  infeasible at  arrives  min V_v   min h")
    rescued = [r for r in failed if "starts" in r]
    for r in sorted(rescued, key=lambda r: (-same_outcome(r), r["seed"])):
        without, with_volume = r["dob-cbf-qp"], r["dob-vcbf-qp"]
        print(
            f"{r['seed']:>6}{same_outcome(r):>8} of {STARTS}"
            f"{without['running_time']:>13.2f} s"
            f"{'yes':>9}{with_volume['min_volume']:>9.3f}"
            f"{with_volume['min_barrier']:>8.3f}"
        )


def main() -> None:
    """Runs what of the search has not been run, then reports on all of it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--layouts", type=int, default=600, help="how many courses")
    parser.add_argument("--workers", type=int, default=2, help="how many processes")
    parser.add_argument(
        "--out", type=Path, default=Path("out/search_layouts.jsonl"), help="results"
    )
    parser.add_argument("--short", action="store_true", help="2 courses, for a check")
    arguments = parser.parse_args()
    count = 2 if arguments.short else arguments.layouts
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    lines = arguments.out.read_text().splitlines() if arguments.out.exists() else []
    records = [json.loads(line) for line in lines if line.endswith("}")]
    arguments.out.write_text("".join(json.dumps(r) + "\n" for r in records))
    missing = sorted(set(range(count)) - {r["seed"] for r in records})
    spawn = multiprocessing.get_context("spawn")
    with (
        arguments.out.open("a") as file,
        ProcessPoolExecutor(arguments.workers, mp_context=spawn) as pool,
    ):
        for done in as_completed(pool.submit(try_course, seed) for seed in missing):
            records.append(done.result())
            file.write(json.dumps(records[-1]) + "\n")
            file.flush()
    report([r for r in records if r["seed"] < count])


if __name__ == "__main__":
    main()
