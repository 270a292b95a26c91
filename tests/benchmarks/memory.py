"""Memory of a long run, its log in memory and on disk.

python tests/benchmarks/memory.py [SECONDS]
"""

from multiprocessing import get_context
from pathlib import Path
import resource
import sys
import tempfile

from vcbf_drake import load_scenario, simulate


def resident() -> float:
    """Memory of this process that is its own, without mapped files [MB]."""
    pages = [int(number) for number in Path("/proc/self/statm").read_text().split()]
    return (pages[1] - pages[2]) * resource.getpagesize() / 1e6


def samples(duration: float, log_directory: str | None) -> tuple[list[float], str]:
    """Returns the memory at every tenth of a run and at its end, and what its log is.

    Args:
        duration: Of the run [s].
        log_directory: Where its log goes; in memory if None.
    """
    scenario = load_scenario(
        "blimp-multiple-obstacles", overrides=f"{{duration: {duration}}}"
    )
    found: list[float] = []
    result = simulate(
        scenario, lambda _: found.append(resident()), log_directory=log_directory
    )
    ticks = len(result.log["time"])
    log = sum(array.nbytes for array in result.log.values()) / 1e6
    size = f"{ticks} ticks, log {log:.1f} MB, {1e6 * log / ticks:.0f} bytes a tick"
    return [*found[9::10], resident()], size


def main() -> None:
    """Prints the memory at every tenth of the run, and how large the log is."""
    duration = float(sys.argv[1]) if len(sys.argv) > 1 else 600.0
    with (
        tempfile.TemporaryDirectory() as directory,
        get_context("spawn").Pool(1, maxtasksperchild=1) as pool,
    ):
        in_memory, size = pool.apply(samples, (duration, None))
        on_disk, _ = pool.apply(samples, (duration, directory))
    print("| simulated [s] | log in memory [MB] | log on disk [MB] |")
    print("| --- | --- | --- |")
    for tenth, both in enumerate(zip(in_memory, on_disk, strict=True), start=1):
        when = f"{tenth * duration / 10:.0f}" if tenth <= 10 else "summarised"
        print(f"| {when} | {both[0]:.1f} | {both[1]:.1f} |")
    print(f"\n{size}")


if __name__ == "__main__":
    main()
