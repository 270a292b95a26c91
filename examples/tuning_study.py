"""A tuning study: widening and gain of the volume barrier on the same courses.

Flies courses on which the filter without a volume barrier becomes infeasible, once for
each setting of the barrier, and counts the runs that remain feasible and that arrive,
with their times and distances.

    python examples/tuning_study.py

Of the first 600 courses of examples/search_layouts.py, all that the filter without a
volume barrier loses (an interrupted study resumes):

    python examples/tuning_study.py --courses 600 --workers 2
"""

import argparse
from dataclasses import asdict
from pathlib import Path
from statistics import median

from matplotlib.figure import Figure
import numpy as np
from paper.blimp_courses import BLIMP_COURSES
from pictures import COLORS

from vcbf_drake import simulate
from vcbf_drake.safety import VolumeBarrier
from vcbf_drake.simulation.loading import merge_overrides
from vcbf_drake.studies import Trial, run_study

SETTINGS = {
    "the paper's form": VolumeBarrier(gain=3.0, widening=1.0),
    "8 x as wide, same gain": VolumeBarrier(gain=3.0, widening=8.0),
    "4 x as wide, gain 0.2": VolumeBarrier(gain=0.2, widening=4.0),
    "8 x as wide, gain 0.1": VolumeBarrier(gain=0.1, widening=8.0),
}
COURSES = [84, 9, 197]


def flight(course, barrier, duration):
    """Returns the trial of one course, at most `duration` long [s]."""
    overrides = merge_overrides({"duration": duration, "volume": asdict(barrier)})
    return Trial(
        "blimp-multiple-obstacles",
        "dob-vcbf-qp",
        course,
        variation=BLIMP_COURSES,
        overrides=overrides,
    )


def is_kept(summary):
    """Whether the QP had a solution until the end or the target, without collision."""
    ended = (summary["infeasible_at"], summary["collided_at"])
    return summary["reached_at"] is not None or ended == (None, None)


def room(result):
    """Returns det B of the true set, the paper's measure, at every tick, (T,)."""
    scale = result.scenario.input_set.input_set().scale
    with np.errstate(invalid="ignore"):
        share = np.linalg.det(result.log["ellipsoid_shape"]) / scale.prod()
    return np.nan_to_num(share)  # Nothing is left of an empty set.


def report(flights):
    """Prints one line a setting."""
    print(f"{'':<26}courses  kept  arrived   median [s]  median min h [m]")
    for name, summaries in flights.items():
        times = [s["reached_at"] for s in summaries if s["reached_at"] is not None]
        print(
            f"{name:<26}{len(summaries):7}{sum(map(is_kept, summaries)):6}"
            f"{len(times):9}{median(times or [np.nan]):13.1f}"
            f"{median(s['min_barrier'] for s in summaries):18.2f}"
        )


def draw(flights):
    """Writes out/examples/tuning_study.png: distance left, and the room for inputs."""
    figure = Figure(figsize=(9.0, 4.4), layout="constrained")
    panels = figure.subplots(2, len(COURSES), sharex="col", sharey="row")
    # Thinner and thinner, for some of them fly the same way.
    styles = zip(COLORS, (4.0, 2.5, 1.5, 1.5), strict=False)
    for (name, results), (color, width) in zip(flights.items(), styles, strict=False):
        line = {"color": color, "lw": width, "label": name}
        for result, (left, share) in zip(results, panels.T, strict=False):
            log, target = result.log, np.array(result.scenario.target)
            distance = np.linalg.norm(log["state"][:, :3] - target, axis=1)
            stop = np.argmax(distance < 0.3) or len(distance)
            for axes, values in ((left, distance), (share, room(result))):
                axes.plot(log["time"][:stop], values[:stop], **line)
                if not is_kept(result.summary):
                    axes.plot(log["time"][-1], values[-1], "x", color=color, ms=9)
    for course, axes in zip(COURSES, panels[0], strict=True):
        axes.set_title(f"course {course}", fontsize=10)
    panels[0, 0].set(ylabel="to the target [m]")
    panels[1, 0].set(ylabel="room, det B [-]")
    for axes in panels[1]:
        axes.set(xlabel="time [s]")
    handles = panels[0, 0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper center", ncols=4, frameon=False)
    path = Path("out/examples/tuning_study.png")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def lost(count, workers):
    """Returns the courses that the filter without a volume barrier loses in 20 s."""
    trials = [
        Trial("blimp-multiple-obstacles", "dob-cbf-qp", i, variation=BLIMP_COURSES)
        for i in range(count)
    ]
    records = run_study(trials, Path("out/tuning_study/none.jsonl"), None, workers)
    return [r["index"] for r in records if r["outcome"] == "infeasible"]


def main() -> None:
    """Flies the courses with every setting, then reports, and draws the three."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--courses", type=int, help="this many, of which the lost ones")
    parser.add_argument("--workers", type=int, default=2, help="how many processes")
    parser.add_argument("--short", action="store_true", help="5 s only, for a check")
    options = parser.parse_args()
    duration = 5.0 if options.short else 40.0
    if options.courses:
        courses, records = lost(options.courses, options.workers), {}
        for i, (name, barrier) in enumerate(SETTINGS.items()):
            trials = [flight(course, barrier, duration) for course in courses]
            path = Path(f"out/tuning_study/setting-{i + 1}.jsonl")
            records[name] = run_study(trials, path, None, options.workers)
        report(records)
        return
    flights = {
        name: [simulate(flight(c, barrier, duration).load()) for c in COURSES]
        for name, barrier in SETTINGS.items()
    }
    report({name: [r.summary for r in results] for name, results in flights.items()})
    draw(flights)


if __name__ == "__main__":
    main()
