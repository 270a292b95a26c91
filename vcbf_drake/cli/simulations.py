"""The commands about single runs: list, show, schema, run, compare, check, diagram."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vcbf_drake.cli.options import (
    MethodOption,
    OverrideOption,
    ScenarioArgument,
    ScenarioNameOption,
    load_vehicles,
    method_names,
    out_option,
)
from vcbf_drake.cli.progress import Advance, progress
from vcbf_drake.files import json_text, whole_directory

if TYPE_CHECKING:
    from vcbf_drake.simulation.fleet import Fleet
    from vcbf_drake.simulation.result import Result


def list_scenarios() -> None:
    """List the shipped scenarios, and where they are."""
    from vcbf_drake.simulation.loading import (
        load_scenario,
        scenario_path,
        shipped_scenarios,
    )
    from vcbf_drake.viz.terminal import print_scenarios

    names = shipped_scenarios()
    print_scenarios([load_scenario(name) for name in names])
    typer.echo(f"in {scenario_path(names[0]).parent}", err=True)


def show(scenario: ScenarioArgument) -> None:
    """Print a scenario's file, to copy and change: show NAME > mine.yaml."""
    from vcbf_drake.simulation.loading import scenario_path

    typer.echo(scenario_path(scenario).read_text(encoding="utf-8"), nl=False)


def schema() -> None:
    """Print the JSON schema of scenario files, for editors."""
    from vcbf_drake.simulation.schema import scenario_schema

    typer.echo(json_text(scenario_schema()), nl=False)


def run(
    scenario: ScenarioArgument,
    method: MethodOption = None,
    override: OverrideOption = None,
    scenario_name: ScenarioNameOption = None,
    out: Annotated[Path | None, out_option("out/SCENARIO-METHOD")] = None,
    replay: Annotated[
        bool, typer.Option("--replay/--no-replay", help="Write a Meshcat replay.")
    ] = True,
    figures: Annotated[
        bool, typer.Option("--figures/--no-figures", help="Write the figures.")
    ] = True,
    live: Annotated[
        bool,
        typer.Option("--live", help="In real time, in a browser of this computer."),
    ] = False,
    by_hand: Annotated[
        bool,
        typer.Option(
            "--by-hand",
            help="Live, with sliders or a gamepad in the controller's place.",
        ),
    ] = False,
    log_to: Annotated[
        Path | None,
        typer.Option(
            "--log-to",
            metavar="DIR",
            file_okay=False,
            help="Let the log grow there while the run goes, one .npy file an array.",
        ),
    ] = None,
) -> None:
    """Simulate one scenario: results, figures, a replay and a summary."""
    fleet = load_vehicles(scenario, override, method, scenario_name)
    directory = out or Path("out") / f"{fleet.name}-{fleet.vehicles[0].method}"
    if live or by_hand:
        results = _simulate_live(fleet, by_hand, log_to)
    with progress() as begin:
        if not (live or by_hand):
            results = _simulate(fleet, begin, log_to)
        with whole_directory(directory) as staging:
            _save(results, staging)
        write_pictures(results, directory, begin, replay=replay, figures=figures)
    report_results(results, directory)


def compare(
    scenario: ScenarioArgument,
    methods: Annotated[
        str | None,
        typer.Option(metavar="M,M,...", help="Safety filters; by default all."),
    ] = None,
    override: OverrideOption = None,
    scenario_name: ScenarioNameOption = None,
    out: Annotated[Path | None, out_option("out/SCENARIO")] = None,
) -> None:
    """Simulate one scenario under several methods: one replay, one set of figures.

    They bring out the scenario's own method.
    """
    from vcbf_drake.safety.settings import METHODS

    names = list(METHODS) if methods is None else method_names(methods)
    fleets = [load_vehicles(scenario, override, m, scenario_name) for m in names]
    directory = out or Path("out") / fleets[0].name
    with progress() as begin:
        runs = [_simulate(fleet, begin) for fleet in fleets]
        with whole_directory(directory) as staging:
            for method, results in zip(names, runs, strict=True):
                _save(results, staging / method)
        own = load_vehicles(scenario, override, None, scenario_name).vehicles[0].method
        in_front = sorted(runs, key=lambda each: each[0].scenario.method == own)
        write_pictures(list(chain(*in_front)), directory, begin)
    report_results(list(chain(*runs)), directory)


def check(
    scenario: ScenarioArgument,
    method: MethodOption = None,
    override: OverrideOption = None,
    scenario_name: ScenarioNameOption = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON instead of a table.")
    ] = False,
) -> None:
    """List the theorems' hypotheses with their numbers, before anything moves."""
    from vcbf_drake.simulation.run import check_assumptions
    from vcbf_drake.viz.terminal import print_assumptions

    fleet = load_vehicles(scenario, override, method, scenario_name)
    assumptions = check_assumptions(fleet)
    if as_json:
        numbers = [dataclasses.asdict(each) for each in assumptions]
        typer.echo(json_text(numbers), nl=False)
    else:
        print_assumptions(f"{fleet.name}, {fleet.vehicles[0].method}", assumptions)


def diagram(
    scenario: ScenarioArgument,
    method: MethodOption = None,
    override: OverrideOption = None,
    scenario_name: ScenarioNameOption = None,
    out: Annotated[Path | None, out_option("out/SCENARIO-diagram")] = None,
) -> None:
    """Draw the block diagrams of the loop and of its filter, as DOT and SVG."""
    from vcbf_drake.simulation.fleet import loops_of, make_fleet_loop
    from vcbf_drake.viz.diagram import write_diagram

    fleet = load_vehicles(scenario, override, method, scenario_name)
    directory = out or Path("out") / f"{fleet.name}-diagram"
    with whole_directory(directory) as staging:
        whole = make_fleet_loop(fleet)
        loops = loops_of(whole, fleet)
        for each in dict.fromkeys([whole, *loops]):
            write_diagram(each, staging, each.get_name())
        safety_filter = loops[0].GetSubsystemByName("filter")
        write_diagram(safety_filter, staging, "safety-filter")
    typer.echo(f"written to {directory}")


def _simulate(
    fleet: Fleet, begin: Callable[[str], Advance], log_directory: Path | None = None
) -> list[Result]:
    from vcbf_drake.simulation.run import simulate_fleet

    advance = begin(fleet.vehicles[0].method)
    return simulate_fleet(fleet, advance, log_directory=log_directory)


def _save(results: list[Result], directory: Path) -> None:
    """Saves results; those of several vehicles in directories of their names."""
    for each in results:
        several = len(results) > 1
        each.save(directory / each.scenario.name if several else directory)


def _simulate_live(
    fleet: Fleet, by_hand: bool, log_directory: Path | None
) -> list[Result]:
    from vcbf_drake.simulation.run import simulate_fleet
    from vcbf_drake.viz.live import LiveView, Stick

    def tell(address: str) -> None:
        typer.echo(f"open {address} in a browser; the run begins there", err=True)

    driven = fleet.only("--by-hand") if by_hand else None
    view = LiveView(fleet.vehicles, tell)
    try:
        controller = Stick(view.meshcat, driven) if driven else None
        return simulate_fleet(
            fleet, log_directory=log_directory, watch=view, controller=controller
        )
    finally:
        view.close()


def write_pictures(
    results: list[Result],
    directory: Path,
    begin: Callable[[str], Advance],
    replay: bool = True,
    figures: bool = True,
) -> None:
    """Writes the figures of results, and their replay, each when all of it is there."""
    if figures:
        from vcbf_drake.viz.figures import write_figures

        advance = begin("figures")
        with whole_directory(directory) as staging:
            write_figures(results, staging)
        advance(1.0)
    if replay:
        from vcbf_drake.viz.replay import write_replay

        advance = begin("replay")
        with whole_directory(directory) as staging:
            write_replay(results, staging / "replay.html")
        advance(1.0)


def report_results(results: list[Result], directory: Path) -> None:
    """Prints the summaries, and where the results are."""
    from vcbf_drake.viz.runs import barrier_unit
    from vcbf_drake.viz.terminal import print_summaries

    for name in dict.fromkeys(each.scenario.name for each in results):
        own = [each for each in results if each.scenario.name == name]
        unit = barrier_unit(own[0].scenario)
        print_summaries([each.summary for each in own], unit)
    typer.echo(f"written to {directory}")
