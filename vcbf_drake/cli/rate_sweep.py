"""The command rate-sweep: what happens between ticks, from slow control to fast."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from vcbf_drake.cli.options import out_option
from vcbf_drake.cli.outputs import whole_or_not_at_all


def rate_sweep(
    quick: Annotated[
        bool, typer.Option("--quick", help="The two slowest rates alone.")
    ] = False,
    out: Annotated[Path, out_option("out/rate-sweep")] = Path("out/rate-sweep"),
) -> None:
    """Sweep the control rate: the least h between ticks, with a margin and without."""
    from vcbf_drake.studies.rate_sweep import RATES, sweep_markdown, sweep_rates
    from vcbf_drake.viz.terminal import progress_bar

    rates = RATES[:2] if quick else RATES
    with progress_bar() as bar:
        task = bar.add_task("rates", total=1.0)
        records = sweep_rates(rates, lambda done: bar.update(task, completed=done))
    page = sweep_markdown(records, "vcbf-drake rate-sweep" + " --quick" * quick)
    with whole_or_not_at_all(out) as staging:
        (staging / "rate_sweep.md").write_text(page, encoding="utf-8")
        text = json.dumps(records, indent=2, allow_nan=False) + "\n"
        (staging / "rate_sweep.json").write_text(text)
    typer.echo(page)
    typer.echo(f"written to {out}")
