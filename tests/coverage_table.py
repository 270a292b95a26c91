"""Prints how much of each package the tests reach; fails where too little is.

After `pytest --cov`: lines and branches together, as coverage.py counts them.
"""

from __future__ import annotations

from collections import Counter, defaultdict
import json
from pathlib import Path
import sys
import tempfile

import coverage

# The packages that guarantees rest on, and what they must reach at least [%].
HELD = ("model", "barriers", "disturbances", "safety", "between_ticks")
LEAST = 95.0


def package_counts() -> dict[str, Counter[str]]:
    """Returns the lines and branches of every package, all and covered."""
    data = coverage.Coverage()
    data.load()
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "coverage.json")
        data.json_report(outfile=str(report))
        files = json.loads(report.read_text())["files"]
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for path, found in files.items():
        package = Path(path).relative_to("vcbf_drake").parent.parts[:1]
        counts["".join(package) or "vcbf_drake"].update(
            {key: n for key, n in found["summary"].items() if isinstance(n, int)}
        )
    return counts


def main() -> int:
    """Prints the table; 1 when a package is short of what it is held to."""
    print(
        f"{'package':<14}{'lines':>8}{'missed':>8}{'branches':>10}{'missed':>8}{'%':>8}"
    )
    short = []
    for package, n in sorted(package_counts().items()):
        covered = n["covered_lines"] + n["covered_branches"]
        share = 100.0 * covered / max(n["num_statements"] + n["num_branches"], 1)
        print(
            f"{package:<14}{n['num_statements']:>8}{n['missing_lines']:>8}"
            f"{n['num_branches']:>10}{n['missing_branches']:>8}{share:>8.1f}"
        )
        if package in HELD and share < LEAST:
            short.append(package)
    if short:
        print(f"below {LEAST:g} %: {', '.join(short)}")
    return 1 if short else 0


if __name__ == "__main__":
    sys.exit(main())
