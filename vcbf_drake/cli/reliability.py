"""The command reliability: faults in the loop, and hostile ticks, many times."""

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
    properties: Annotated[
        int,
        typer.Option(
            min=0, help="How many hostile ticks to check what the filter promises."
        ),
    ] = 100_000,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="One trial of each, of the car alone, and 2000 ticks."
        ),
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the draws.")] = 0,
    workers: Annotated[
        int | None,
        typer.Option(min=1, show_default="one a processor", help="Processes."),
    ] = None,
    out: Annotated[Path | None, out_option("out/reliability")] = None,
) -> None:
    """Put faults into the loop and hostile data into the filter, and see what breaks.

    Goes on with what DIR holds; with more of it where a number is greater.
    """
    names = None if scenarios is None else tuple(scenarios.split(","))
    directory = out or Path("out") / "reliability"
    workers = workers or os.cpu_count() or 1
    if quick:
        trials, properties = 1, 2000
    command = "vcbf-drake reliability"
    command += "" if scenarios is None else f" --scenarios {scenarios}"
    command += " --quick" if quick else f" --trials {trials} --properties {properties}"
    command += f" --seed {seed}"
    if properties:
        _check_properties(properties, seed, workers, directory, command)
    if trials:
        _put_faults(names, trials, quick, seed, workers, directory, command)
    typer.echo(f"written to {directory}")


def _check_properties(
    examples: int, seed: int, workers: int, directory: Path, command: str
) -> None:
    from vcbf_drake.studies.property_campaign import run_properties
    from vcbf_drake.studies.property_report import (
        property_headline,
        property_markdown,
    )
    from vcbf_drake.viz.terminal import progress_bar

    with progress_bar() as bar:
        task = bar.add_task(f"{examples} hostile ticks", total=1.0)
        counts = run_properties(
            examples,
            directory / "properties.jsonl",
            seed,
            workers,
            progress=lambda done: bar.update(task, completed=done),
        )
    with whole_or_not_at_all(directory) as staging:
        page = property_markdown(counts, seed, command)
        (staging / "properties.md").write_text(page, encoding="utf-8")
    for sentence in property_headline(counts):
        typer.echo(sentence)


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
