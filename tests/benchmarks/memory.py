"""Memory of a long run: python tests/benchmarks/memory.py [SECONDS]."""

from pathlib import Path
import resource
import sys

from vcbf_drake import load_scenario, simulate


def resident() -> float:
    """Resident memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def main() -> None:
    """Prints the memory at every tenth of the run, and what of it is the log."""
    duration = float(sys.argv[1]) if len(sys.argv) > 1 else 600.0
    scenario = load_scenario(
        "blimp-multiple-obstacles", overrides=f"{{duration: {duration}}}"
    )
    samples: list[tuple[float, float]] = []
    result = simulate(scenario, lambda done: samples.append((done, resident())))
    ticks = len(result.log["time"])
    log = sum(array.nbytes for array in result.log.values()) / 1e6
    print("| simulated [s] | resident [MB] |\n| --- | --- |")
    for done, megabytes in samples[9::10]:
        print(f"| {done * duration:.0f} | {megabytes:.1f} |")
    print(f"\n{ticks} ticks, log {log:.1f} MB, {1e6 * log / ticks:.0f} bytes a tick")


if __name__ == "__main__":
    main()
