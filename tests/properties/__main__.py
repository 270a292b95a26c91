"""The property campaign: `python -m tests.properties`, or `make properties`.

Ends with status 1 if a promise was broken.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
import sys

from tests.properties.campaign import run_properties
from tests.properties.report import property_headline, property_markdown
from vcbf_drake.errors import ScenarioError

QUICK = 4000


def main() -> int:
    """Runs the campaign, writes its page and returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.properties",
        description="Checks the filter's promises on random hostile ticks. Goes on with"
        " what DIR holds. A million take about a quarter of an hour on two cores.",
    )
    parser.add_argument("--ticks", type=int, default=1_000_000, metavar="N")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} ticks")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument(
        "--out", type=Path, default=Path("out") / "properties", metavar="DIR"
    )
    options = parser.parse_args()
    ticks = QUICK if options.quick else options.ticks
    path = options.out / "properties.jsonl"
    try:
        counts = run_properties(
            ticks, path, options.seed, options.workers, progress=_show_progress
        )
    except ScenarioError as error:
        parser.error(str(error))
    command = f"python -m tests.properties --ticks {ticks} --seed {options.seed}"
    page = options.out / "properties.md"
    page.write_text(property_markdown(counts, options.seed, command), encoding="utf-8")
    print(*property_headline(counts), *_failures(counts.failures), sep="\n")
    print(f"written to {page}")
    return 1 if counts.failed else 0


def _show_progress(done: float) -> None:
    end = "\n" if done >= 1.0 or not sys.stderr.isatty() else ""
    print(f"\r{done:6.1%}", end=end, file=sys.stderr, flush=True)


def _failures(failures: list[dict[str, object]]) -> list[str]:
    return [
        f"example {each['number']} ({each['kind']}): {each['broken']}"
        for each in failures[:20]
    ]


if __name__ == "__main__":
    sys.exit(main())
