"""The tables of docs/results/performance.md: python tests/benchmarks/tick_tables.py."""

from vcbf_drake.studies.tick_times import STAGES, tick_times

VARIATIONS = {
    "obstacles": [
        {"num_obstacles": n, "num_cutting": min(n, 2)} for n in (1, 3, 10, 30, 100, 200)
    ],
    "obstacles, on the plateau": [
        {"num_obstacles": n, "num_cutting": 0} for n in (1, 3, 10, 30, 100, 200)
    ],
    "cutting obstacles": [
        {"num_obstacles": 8, "num_cutting": n} for n in (0, 1, 2, 4, 8)
    ],
    "inputs": [{"num_inputs": m, "num_cutting": 2} for m in (1, 2, 3, 4, 5, 6)],
    "states": [{"num_states": n} for n in (6, 9, 12, 18)],
    "ticks whose volume row gives way, and ticks without an input": [
        {"method": "dob-vcbf-qp", "room": 0.003},
        {"method": "dob-vcbf-qp", "room": -0.05},
        {"method": "dob-cbf-qp", "room": -0.05},
    ],
    "method": [
        {"method": method, "num_cutting": cutting}
        for method in ("cbf-qp", "dob-cbf-qp", "dob-vcbf-qp")
        for cutting in (0, 2)
    ],
}


def main() -> None:
    """Prints one table a variation: medians, and the tick's 99th percentile [us]."""
    for title, settings in VARIATIONS.items():
        names = list(settings[0])
        columns = [*(name.removeprefix("num_") for name in names), *STAGES, "tick p99"]
        print(f"\n### {title}\n")
        print("| " + " | ".join(columns) + " |")
        print("| --- " * len(columns) + "|")
        for setting in settings:
            times = tick_times(**setting)
            medians = [f"{times[stage]['median']:.0f}" for stage in STAGES]
            chosen = [str(setting[name]) for name in names]
            p99 = f"{times['tick']['p99']:.0f}"
            print("| " + " | ".join([*chosen, *medians, p99]) + " |", flush=True)


if __name__ == "__main__":
    main()
