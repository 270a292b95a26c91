"""Which feasibility measure, how wide, which gain: settings on the same courses.

Flies courses on which the filter without a volume barrier runs out of inputs, once for
each setting of the barrier, and counts: feasible to the end, arrived, when, how close.

    python examples/tuning_study.py

The whole population of examples/search_layouts.py, from the record it leaves (half an
hour a setting on one core):

    python examples/tuning_study.py --record out/search_layouts.jsonl
"""

import argparse
import json
from pathlib import Path
from statistics import median

from matplotlib.figure import Figure
import numpy as np
from pictures import COLORS
from search_layouts import draw_course

from vcbf_drake import simulate
from vcbf_drake.safety import VolumeBarrier

SETTINGS = {
    "the paper's form": VolumeBarrier(),
    "8 x as wide, same gain": VolumeBarrier(widening=8.0, guard="volume"),
    "4 x as wide, gain 0.2": VolumeBarrier(gain=0.2, widening=4.0, guard="volume"),
    "8 x as wide, gain 0.1": VolumeBarrier(gain=0.1, widening=8.0, guard="volume"),
}
COURSES = [84, 9, 197]


def fly(seed, barrier, duration):
    """Returns the result of one flight, at most `duration` long [s]."""
    course = draw_course(seed)
    course.volume, course.duration = barrier, duration
    return simulate(course)


def is_kept(summary):
    """Whether the QP had a solution until the end or the target, without collision."""
    ended = (summary["infeasible_at"], summary["collided_at"])
    return summary["reached_at"] is not None or ended == (None, None)


def room(result):
    """Returns det B of the true set, the paper's measure, at every tick, (T,)."""
    scale = result.scenario.input_set.input_set().scale
    share = np.linalg.det(result.log["ellipsoid_shape"]) / scale.prod()
    return np.nan_to_num(share)  # Nothing is left of an empty set.


def report(flights):
    """Prints one line a setting."""
    print(f"{'':<26}courses  kept  arrived   median [s]  median min h [m]")
    for name, results in flights.items():
        summaries = [result.summary for result in results]
        times = [s["reached_at"] for s in summaries if s["reached_at"] is not None]
        print(
            f"{name:<26}{len(results):7}{sum(map(is_kept, summaries)):6}"
            f"{len(times):9}{median(times or [np.nan]):13.1f}"
            f"{median(s['min_barrier'] for s in summaries):18.2f}"
        )


def draw(flights, seeds):
    """Writes out/examples/tuning_study.png: distance left, and the room for inputs."""
    count = min(len(seeds), 3)
    figure = Figure(figsize=(3.0 * count, 4.4), layout="constrained")
    panels = figure.subplots(2, count, sharex="col", sharey="row", squeeze=False)
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
    for seed, axes in zip(seeds, panels[0], strict=False):
        axes.set_title(f"course {seed}", fontsize=10)
    panels[0, 0].set(ylabel="to the target [m]")
    panels[1, 0].set(ylabel="room, det B [-]")
    for axes in panels[1]:
        axes.set(xlabel="time [s]")
    handles = panels[0, 0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper center", ncols=4, frameon=False)
    path = Path("out/examples/tuning_study.png")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def failing(record):
    """Returns the courses of a search on which the barrier had to be switched on."""
    lines = map(json.loads, record.read_text().splitlines())
    return sorted(line["seed"] for line in lines if "dob-vcbf-qp" in line)


def main() -> None:
    """Flies every course with every setting, then reports and draws."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--record", type=Path, help="what search_layouts.py left")
    parser.add_argument("--duration", type=float, default=40.0, help="at most [s]")
    parser.add_argument("--short", action="store_true", help="5 s only, for a check")
    options = parser.parse_args()
    seeds = failing(options.record) if options.record else COURSES
    duration = 5.0 if options.short else options.duration
    flights = {
        name: [fly(seed, barrier, duration) for seed in seeds]
        for name, barrier in SETTINGS.items()
    }
    report(flights)
    draw(flights, seeds)


if __name__ == "__main__":
    main()
