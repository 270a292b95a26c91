"""vcbf-drake: run, compare and check scenarios from the command line.

Only typer and rich are imported here, so that ``--help`` answers at once; each command
imports what it needs.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import dataclasses
from importlib.metadata import version
import json
import logging
import math
import os
from pathlib import Path
import shutil
import sys
import tempfile
import traceback
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from typer.core import TyperGroup

if TYPE_CHECKING:
    from vcbf_drake.simulation.result import Result
    from vcbf_drake.simulation.scenario import Scenario
    from vcbf_drake.studies import Record, Trial

_FAILED, _BAD_USAGE = 1, 2

# Click's class, wherever the installed typer keeps it.
_UsageError = cast(type[Exception], typer.BadParameter.__base__)


class OneLineGroup(TyperGroup):
    """Commands whose errors are one line on stderr and an exit status.

    Status 2 is bad usage or a bad scenario, 1 anything else. The option
    ``--traceback`` shows where an error comes from.
    """

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Runs the command line and exits."""
        kwargs["standalone_mode"] = False
        try:
            sys.exit(super().main(*args, **kwargs))
        except _UsageError as error:
            _complain(error.format_message())  # type: ignore[attr-defined]
            sys.exit(_BAD_USAGE)
        except typer.Abort:
            _complain("interrupted")
            sys.exit(_FAILED)
        except Exception as error:
            from vcbf_drake.errors import ScenarioError

            if isinstance(error, ScenarioError):
                _complain(str(error))
                sys.exit(_BAD_USAGE)
            kind = type(error).__name__
            _complain(f"{kind}: {error} (vcbf-drake --traceback ... shows where)")
            sys.exit(_FAILED)

    def invoke(self, ctx: Any) -> Any:
        """Runs the command; with ``--traceback``, shows where it failed."""
        try:
            return super().invoke(ctx)
        except (_UsageError, typer.Exit):
            raise
        except Exception:
            if ctx.params["show_traceback"]:
                traceback.print_exc()
            raise


def _complain(message: str) -> None:
    typer.echo(f"vcbf-drake: {' '.join(message.split())}", err=True)


app = typer.Typer(
    cls=OneLineGroup,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

ScenarioArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO", help="A shipped scenario's name, or a YAML file."
    ),
]
MethodOption = Annotated[
    str | None, typer.Option("--method", help="Safety filter, e.g. dob-vcbf-qp.")
]
OverrideOption = Annotated[
    str | None,
    typer.Option(
        "--override", metavar="YAML", help="Values that replace the scenario's."
    ),
]


def _out_option(default: str) -> Any:
    return typer.Option(
        "--out",
        metavar="DIR",
        file_okay=False,
        show_default=default,
        help="Where the results go.",
    )


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(version("vcbf-drake"))
        raise typer.Exit


@app.callback()
def _options(
    show_version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_show_version,
            is_eager=True,
            help="Show the version and exit.",
        ),
    ] = False,
    show_traceback: Annotated[
        bool,
        typer.Option(
            "--traceback", help="Show where an error comes from (before COMMAND)."
        ),
    ] = False,
) -> None:
    """Safety filters for Drake whose QP stays feasible under disturbances."""


@app.command("list")
def list_scenarios() -> None:
    """List the shipped scenarios."""
    from vcbf_drake.simulation.scenario_file import load_scenario, shipped_scenarios
    from vcbf_drake.viz.terminal import print_scenarios

    print_scenarios([load_scenario(name) for name in shipped_scenarios()])


@app.command()
def run(
    scenario: ScenarioArgument,
    method: MethodOption = None,
    override: OverrideOption = None,
    out: Annotated[Path | None, _out_option("out/SCENARIO-METHOD")] = None,
    replay: Annotated[
        bool, typer.Option("--replay/--no-replay", help="Write a Meshcat replay.")
    ] = True,
    figures: Annotated[
        bool, typer.Option("--figures/--no-figures", help="Write the figures.")
    ] = True,
) -> None:
    """Simulate one scenario: results, figures, a replay and a summary."""
    chosen = _load(scenario, override, method)
    directory = out or Path("out") / f"{chosen.name}-{chosen.method}"
    with _whole_or_not_at_all(directory) as staging:
        results = _simulate([chosen])
        results[0].save(staging)
        _write_pictures(results, staging, replay=replay, figures=figures)
    _report(results, directory)


@app.command()
def compare(
    scenario: ScenarioArgument,
    methods: Annotated[
        str | None,
        typer.Option(metavar="M,M,...", help="Safety filters; by default all."),
    ] = None,
    override: OverrideOption = None,
    out: Annotated[Path | None, _out_option("out/SCENARIO")] = None,
) -> None:
    """Simulate one scenario under several methods: one replay, one set of figures."""
    from vcbf_drake.safety.methods import METHODS

    names = list(METHODS) if methods is None else methods.split(",")
    chosen = [_load(scenario, override, name.strip()) for name in dict.fromkeys(names)]
    directory = out or Path("out") / chosen[0].name
    with _whole_or_not_at_all(directory) as staging:
        results = _simulate(chosen)
        for result in results:
            result.save(staging / result.scenario.method)
        _write_pictures(results, staging)
    _report(results, directory)


@app.command()
def check(
    scenario: ScenarioArgument,
    method: MethodOption = None,
    override: OverrideOption = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON instead of a table.")
    ] = False,
) -> None:
    """List the theorems' hypotheses with their numbers, before anything moves."""
    from vcbf_drake.simulation.run import check_assumptions
    from vcbf_drake.viz.terminal import print_assumptions

    chosen = _load(scenario, override, method)
    assumptions = check_assumptions(chosen)
    if as_json:
        plain = [_plain(dataclasses.asdict(each)) for each in assumptions]
        typer.echo(json.dumps(plain, indent=2))
    else:
        print_assumptions(chosen, assumptions)


@app.command()
def diagram(
    scenario: ScenarioArgument,
    method: MethodOption = None,
    override: OverrideOption = None,
    out: Annotated[Path | None, _out_option("out/SCENARIO-diagram")] = None,
) -> None:
    """Draw the block diagrams of the loop and of its filter, as DOT and SVG."""
    from vcbf_drake.simulation.loop import make_loop
    from vcbf_drake.viz.diagram import write_diagram
    from vcbf_drake.viz.filter_diagram import write_filter_diagram

    chosen = _load(scenario, override, method)
    directory = out or Path("out") / f"{chosen.name}-diagram"
    with _whole_or_not_at_all(directory) as staging:
        loop = make_loop(chosen)
        write_diagram(loop, staging, chosen.name)
        safety_filter = loop.GetSubsystemByName("filter")
        write_filter_diagram(safety_filter, staging, "safety-filter")
    typer.echo(f"written to {directory}")


@app.command("monte-carlo")
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
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with what DIR holds.")
    ] = False,
    out: Annotated[Path | None, _out_option("out/SCENARIO-case-N")] = None,
) -> None:
    """Simulate random variations of one scenario, each under every method."""
    from vcbf_drake.studies import TABLE_I, Trial, summarise_study
    from vcbf_drake.viz.running_time_figure import write_running_times
    from vcbf_drake.viz.study_table import print_study

    names = list(dict.fromkeys(name.strip() for name in methods.split(",")))
    chosen = [_load(scenario, override, name) for name in names]
    directory = out or Path("out") / f"{chosen[0].name}-case-{case}"
    path = directory / "trials.jsonl"
    if not resume and path.exists() and path.stat().st_size > 0:
        raise typer.BadParameter(f"{path} has results; --resume goes on with them")
    plan = [
        Trial(scenario, name, index, seed, TABLE_I[case], override or "")
        for index in range(trials)
        for name in names
    ]
    records = _run_study(plan, path, workers or os.cpu_count() or 1)
    summary = summarise_study(plan, records)
    with _whole_or_not_at_all(directory) as staging:
        text = json.dumps(summary, indent=2) + "\n"
        (staging / "summary.json").write_text(text)
        write_running_times(records, summary, staging)
    print_study(summary)
    typer.echo(f"written to {directory}")


def main() -> None:
    """Runs the command line."""
    app()


def _load(name_or_path: str, override: str | None, method: str | None) -> Scenario:
    from vcbf_drake.simulation.scenario_file import load_scenario
    from vcbf_drake.simulation.validation import validate

    scenario = load_scenario(name_or_path, override)
    if method is not None:
        scenario.method = method
        validate(scenario)
    return scenario


def _simulate(scenarios: list[Scenario]) -> list[Result]:
    from vcbf_drake.simulation.run import simulate
    from vcbf_drake.viz.terminal import progress_bar

    def simulate_one(scenario: Scenario) -> Result:
        task = bar.add_task(scenario.method, total=1.0)
        return simulate(scenario, lambda done: bar.update(task, completed=done))

    with progress_bar() as bar:
        return [simulate_one(scenario) for scenario in scenarios]


def _run_study(trials: list[Trial], path: Path, workers: int) -> list[Record]:
    from vcbf_drake.studies import run_study
    from vcbf_drake.viz.terminal import progress_bar

    def show(done: float) -> None:
        bar.update(task, completed=done)

    with progress_bar() as bar:
        task = bar.add_task(f"{len(trials)} runs", total=1.0)
        return run_study(trials, path, workers=workers, progress=show)


def _write_pictures(
    results: list[Result], directory: Path, replay: bool = True, figures: bool = True
) -> None:
    if figures:
        from vcbf_drake.viz.figures import write_figures

        write_figures(results, directory)
    if replay:
        logging.getLogger("drake").setLevel(logging.WARNING)  # Meshcat says its port.
        from vcbf_drake.viz.replay import write_replay

        write_replay(results, directory / "replay.html")


def _report(results: list[Result], directory: Path) -> None:
    from vcbf_drake.viz.terminal import print_summaries

    print_summaries([result.summary for result in results])
    typer.echo(f"written to {directory}")


def _plain(value: Any) -> Any:
    """Returns the value with None for what JSON has no number for."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    finite = not isinstance(value, float) or math.isfinite(value)
    return value if finite else None


@contextmanager
def _whole_or_not_at_all(directory: Path) -> Iterator[Path]:
    """Yields an empty directory whose files move to `directory` when all went well.

    Files of the same name are replaced; others stay.
    """
    directory.parent.mkdir(parents=True, exist_ok=True)
    room = Path(tempfile.mkdtemp(dir=directory.parent, prefix=f".{directory.name}-"))
    try:
        staging = room / "results"
        staging.mkdir()
        yield staging
        for path in [path for path in staging.rglob("*") if path.is_file()]:
            target = directory / path.relative_to(staging)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, target)
    finally:
        shutil.rmtree(room, ignore_errors=True)


if __name__ == "__main__":
    main()
