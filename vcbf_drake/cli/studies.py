"""The commands about many runs: monte-carlo and faults."""

from __future__ import annotations

from concurrent.futures import Executor
from contextlib import ExitStack
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vcbf_drake.cli.options import (
    OverrideOption,
    ScenarioArgument,
    ScenarioNameOption,
    load,
    load_vehicles,
    method_names,
    out_option,
)
from vcbf_drake.cli.progress import progress

if TYPE_CHECKING:
    from vcbf_drake.simulation.fleet import Fleet
    from vcbf_drake.studies import Record, Trial

_SeedOption = Annotated[int, typer.Option(min=0, help="Seed of the draws.")]
_WorkersOption = Annotated[
    int | None,
    typer.Option(min=1, show_default="one a processor", help="Processes."),
]


def monte_carlo(
    scenario: ScenarioArgument,
    trials: Annotated[int, typer.Option(min=1, help="How many draws.")],
    vary: Annotated[
        str | None,
        typer.Option(
            metavar="VARIATION",
            show_default="every state of the start, by up to 0.05",
            help="What is drawn for each trial: YAML like 'observer.alpha: !Uniform"
            " [4.6, 6.0]' (also !Normal, !Choice; !Add and !Scale change the"
            " scenario's own value), a YAML file of it, or a Python file with a"
            " function draw(scenario, generator).",
        ),
    ] = None,
    methods: Annotated[
        str,
        typer.Option(
            metavar="M,M,...", help="Safety filters; the others against the first."
        ),
    ] = "dob-cbf-qp,dob-vcbf-qp",
    override: OverrideOption = None,
    scenario_name: ScenarioNameOption = None,
    seed: _SeedOption = 0,
    workers: _WorkersOption = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="A Dask cluster instead, e.g. tcp://host:8786."
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with what DIR holds.")
    ] = False,
    out: Annotated[Path | None, out_option("out/SCENARIO-monte-carlo")] = None,
) -> None:
    """Simulate random variations of one scenario, each under every method."""
    from vcbf_drake.files import json_text, whole_directory
    from vcbf_drake.studies import Trial, load_variation, summarise_study
    from vcbf_drake.viz.running_time_figure import write_running_times
    from vcbf_drake.viz.terminal import print_study

    if scheduler is not None and workers is not None:
        raise typer.BadParameter("--scheduler and --workers exclude each other")
    names = method_names(methods)
    fleets = [load_vehicles(scenario, override, m, scenario_name) for m in names]
    directory = out or Path("out") / f"{fleets[0].name}-monte-carlo"
    variation = load_variation(vary or _random_start(fleets[0]))
    plan = [
        Trial(
            scenario,
            each,
            index,
            seed,
            variation,
            override or "",
            scenario_name or "",
        )
        for index in range(trials)
        for each in names
    ]
    plan[0].load_fleet()  # A draw that does not load is refused before anything runs.
    path = directory / "trials.jsonl"
    if not resume and path.exists() and path.stat().st_size > 0:
        raise typer.BadParameter(f"{path} has results; --resume goes on with them")
    with ExitStack() as stack:
        executor = None
        if scheduler is not None:
            from vcbf_drake.studies.executors import dask_executor

            try:
                executor = stack.enter_context(dask_executor(scheduler))
            except (ImportError, OSError, RuntimeError) as error:
                raise typer.BadParameter(f"--scheduler: {error}") from error
        records = _run_trials(plan, path, workers, executor)
    summary = summarise_study(plan, records)
    with whole_directory(directory) as staging:
        (staging / "summary.json").write_text(json_text(summary))
        write_running_times(records, summary, staging)
    print_study(summary)
    typer.echo(f"written to {directory}")


def faults(
    scenarios: Annotated[
        list[str],
        typer.Argument(metavar="SCENARIO...", help="What to break."),
    ],
    trials: Annotated[
        int, typer.Option(min=1, help="How many of each fault, method and fidelity.")
    ] = 5,
    seed: _SeedOption = 0,
    workers: _WorkersOption = None,
    out: Annotated[Path, out_option("out/faults")] = Path("out/faults"),
) -> None:
    """Put faults into the loop, one at a time, and see what breaks.

    Goes on with what DIR holds; with more of it where TRIALS is greater.
    """
    from vcbf_drake.files import json_text, whole_directory
    from vcbf_drake.studies.faults import (
        KIND,
        campaign_markdown,
        fault_trials,
        headline,
        summarise_faults,
    )

    for name in scenarios:
        load(name, None, None)
    kinds = fault_trials(scenarios, trials, seed)
    plan = [trial for kind in kinds.values() for trial in kind]
    for kind in kinds.values():
        kind[0].load()  # So is a draw that does not load.
    path = out / "trials.jsonl"
    records = _run_trials(plan, path, workers)
    summaries = {
        kind: summarise_faults(records[i * trials : (i + 1) * trials])
        for i, kind in enumerate(kinds)
    }
    command = f"vcbf-drake faults {' '.join(scenarios)} --trials {trials} --seed {seed}"
    rows = [
        dict(zip(KIND, kind, strict=True)) | summary
        for kind, summary in summaries.items()
    ]
    with whole_directory(out) as staging:
        page = campaign_markdown(summaries, command)
        (staging / "faults.md").write_text(page, encoding="utf-8")
        (staging / "summary.json").write_text(json_text(rows))
    for sentence in headline(summaries):
        typer.echo(sentence)
    typer.echo(f"written to {out}")


def _random_start(fleet: Fleet) -> str:
    several = len(fleet.vehicles) > 1
    entries = [
        f"{f'vehicles.{i}.' * several}initial_state.{k}: !Add [-0.05, 0.05]"
        for i, each in enumerate(fleet.vehicles)
        for k in range(len(each.initial_state))
    ]
    return "{" + ", ".join(entries) + "}"


def _run_trials(
    trials: list[Trial],
    path: Path,
    workers: int | None,
    executor: Executor | None = None,
) -> list[Record]:
    from vcbf_drake.studies import run_study

    processes = workers or os.cpu_count() or 1
    with progress() as begin:
        return run_study(
            trials, path, executor, processes, begin(f"{len(trials)} runs")
        )
