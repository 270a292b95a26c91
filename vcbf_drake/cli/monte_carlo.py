"""The command monte-carlo: random variations of one scenario."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vcbf_drake.cli.options import OverrideOption, ScenarioArgument, load, out_option
from vcbf_drake.cli.outputs import whole_or_not_at_all

if TYPE_CHECKING:
    from vcbf_drake.studies import Record, Trial


def monte_carlo(
    scenario: ScenarioArgument,
    trials: Annotated[int, typer.Option(min=1, help="How many draws.")],
    case: Annotated[
        int,
        typer.Option(
            min=1, max=2, help="What is drawn: 1 the start, 2 the observer's gains."
        ),
    ] = 1,
    methods: Annotated[
        str,
        typer.Option(
            metavar="M,M,...", help="Safety filters; the others against the first."
        ),
    ] = "dob-cbf-qp,dob-vcbf-qp",
    override: OverrideOption = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the draws.")] = 0,
    workers: Annotated[
        int | None,
        typer.Option(min=1, show_default="one a processor", help="Processes."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="A Dask cluster instead, e.g. tcp://host:8786."
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with what DIR holds.")
    ] = False,
    out: Annotated[Path | None, out_option("out/SCENARIO-case-N")] = None,
) -> None:
    """Simulate random variations of one scenario, each under every method."""
    from vcbf_drake.studies import TABLE_I, Trial, summarise_study
    from vcbf_drake.viz.running_time_figure import write_running_times
    from vcbf_drake.viz.study_table import print_study

    if scheduler is not None and workers is not None:
        raise typer.BadParameter("--scheduler and --workers exclude each other")
    names = list(dict.fromkeys(name.strip() for name in methods.split(",")))
    chosen = [load(scenario, override, name) for name in names]
    directory = out or Path("out") / f"{chosen[0].name}-case-{case}"
    path = directory / "trials.jsonl"
    if not resume and path.exists() and path.stat().st_size > 0:
        raise typer.BadParameter(f"{path} has results; --resume goes on with them")
    plan = [
        Trial(scenario, name, index, seed, TABLE_I[case], override or "")
        for index in range(trials)
        for name in names
    ]
    if scheduler is None:
        records = _run_study(plan, path, workers=workers or os.cpu_count() or 1)
    else:
        with _cluster(scheduler) as executor:
            records = _run_study(plan, path, executor)
    summary = summarise_study(plan, records)
    with whole_or_not_at_all(directory) as staging:
        text = json.dumps(summary, indent=2) + "\n"
        (staging / "summary.json").write_text(text)
        write_running_times(records, summary, staging)
    print_study(summary)
    typer.echo(f"written to {directory}")


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    from vcbf_drake.studies.dask_cluster import dask_executor

    with ExitStack() as stack:
        try:
            executor = stack.enter_context(dask_executor(address))
        except (ImportError, OSError, RuntimeError) as error:
            raise typer.BadParameter(f"--scheduler: {error}") from error
        yield executor


def _run_study(
    trials: list[Trial], path: Path, executor: Executor | None = None, workers: int = 1
) -> list[Record]:
    from vcbf_drake.studies import run_study
    from vcbf_drake.viz.terminal import progress_bar

    def show(done: float) -> None:
        bar.update(task, completed=done)

    with progress_bar() as bar:
        task = bar.add_task(f"{len(trials)} runs", total=1.0)
        return run_study(trials, path, executor, workers, show)
