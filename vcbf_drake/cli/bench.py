"""The command bench: what a tick costs, here and by the packages people know."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from vcbf_drake.cli.options import out_option
from vcbf_drake.cli.outputs import whole_or_not_at_all


def bench(
    quick: Annotated[
        bool, typer.Option("--quick", help="Few instances, for a check.")
    ] = False,
    out: Annotated[Path, out_option("out/bench")] = Path("out/bench"),
) -> None:
    """Measure ticks against the peers that are installed, speed beside accuracy."""
    from vcbf_drake.studies.bench import run_bench
    from vcbf_drake.viz.bench_figure import write_bench
    from vcbf_drake.viz.bench_table import print_bench
    from vcbf_drake.viz.terminal import progress_bar

    with progress_bar() as bar:
        task = bar.add_task("benchmark", total=1.0)
        results = run_bench(quick, lambda done: bar.update(task, completed=done))
    with whole_or_not_at_all(out) as staging:
        text = json.dumps(results, indent=2, allow_nan=False) + "\n"
        (staging / "bench.json").write_text(text)
        write_bench(results, staging)
    print_bench(results)
    typer.echo(f"written to {out}")
