"""The command reliability: faults in the loop, many times."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated

import typer

from vcbf_drake.cli.options import out_option
from vcbf_drake.cli.outputs import whole_or_not_at_all


def reliability(
    scenarios: Annotated[
        str | None,
        typer.Option(
            metavar="S,S,...",
            show_default="blimp-multiple-obstacles,car-avoidance",
            help="What to break.",
        ),
    ] = None,
    trials: Annotated[
        int,
        typer.Option(min=0, help="How many of each fault, method and fidelity."),
    ] = 100,
    quick: Annotated[
        bool,
        typer.Option("--quick", help="One trial of each, of the car alone."),
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the draws.")] = 0,
    workers: Annotated[
        int | None,
        typer.Option(min=1, show_default="one a processor", help="Processes."),
    ] = None,
    out: Annotated[Path | None, out_option("out/reliability")] = None,
) -> None:
    """Put faults into the loop, and see what breaks.

    Goes on with what DIR holds; with more of it where a number is greater.
    """
    names = None if scenarios is None else tuple(scenarios.split(","))
    directory = out or Path("out") / "reliability"
    workers = workers or os.cpu_count() or 1
    if quick:
        trials = 1
    command = "vcbf-drake reliability"
    command += "" if scenarios is None else f" --scenarios {scenarios}"
    command += " --quick" if quick else f" --trials {trials}"
    command += f" --seed {seed}"
    if trials:
        _put_faults(names, trials, quick, seed, workers, directory, command)
    typer.echo(f"written to {directory}")


def _put_faults(
    names: tuple[str, ...] | None,
    trials: int,
    quick: bool,
    seed: int,
    workers: int,
    directory: Path,
    command: str,
) -> None:
    from vcbf_drake.studies.fault_campaign import (
        SCENARIOS,
        fault_trials,
        summarise_faults,
    )
    from vcbf_drake.studies.fault_report import campaign_markdown, headline
    from vcbf_drake.studies.monte_carlo import run_study
    from vcbf_drake.viz.terminal import progress_bar

    names = names or SCENARIOS
    kinds = fault_trials(names[-1:] if quick else names, trials, seed)
    plan = [trial for kind in kinds.values() for trial in kind]
    with progress_bar() as bar:
        task = bar.add_task(f"{len(plan)} runs", total=1.0)
        records = run_study(
            plan,
            directory / "trials.jsonl",
            workers=workers,
            progress=lambda done: bar.update(task, completed=done),
        )
    summaries = {
        kind: summarise_faults(records[i * trials : (i + 1) * trials])
        for i, kind in enumerate(kinds)
    }
    with whole_or_not_at_all(directory) as staging:
        page = campaign_markdown(summaries, trials, seed, command)
        (staging / "reliability.md").write_text(page, encoding="utf-8")
        rows = [
            dict(zip(("scenario", "fault", "method", "fidelity"), kind, strict=True))
            | summary
            for kind, summary in summaries.items()
        ]
        (staging / "summary.json").write_text(json.dumps(rows, indent=2) + "\n")
    for sentence in headline(summaries):
        typer.echo(sentence)
