"""The command replay-log: the run in a log of the bus, reported as by `run`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vcbf_drake.cli.options import OverrideOption, load, out_option
from vcbf_drake.cli.progress import progress
from vcbf_drake.cli.simulations import report_results, write_pictures
from vcbf_drake.files import whole_directory

if TYPE_CHECKING:
    from vcbf_drake.hil import LogReplay


def replay_log(
    log: Annotated[
        Path, typer.Argument(metavar="FILE", help="What --log wrote, or an LCM log.")
    ],
    scenario: Annotated[
        str | None,
        typer.Argument(
            metavar="[SCENARIO]",
            help="What was run.",
            show_default="what the log says",
        ),
    ] = None,
    override: OverrideOption = None,
    name: Annotated[
        str | None,
        typer.Option(help="Of which vehicle.", show_default="the only one"),
    ] = None,
    out: Annotated[Path | None, out_option("out/FILE")] = None,
    replay: Annotated[
        bool, typer.Option("--replay/--no-replay", help="Write a Meshcat replay.")
    ] = True,
    figures: Annotated[
        bool, typer.Option("--figures/--no-figures", help="Write the figures.")
    ] = True,
) -> None:
    """Tell a run on hardware from its log: results, figures, a replay and a summary.

    Observer, controller and filter run again on the logged states, the same every time.
    The disturbance is what the states tell with hindsight.
    """
    from vcbf_drake.hil import EventLogError, replay_log
    from vcbf_drake.viz.terminal import print_hardware_report

    if override is not None and scenario is None:
        raise typer.BadParameter("--override needs a SCENARIO")
    chosen = None if scenario is None else load(scenario, override, None)
    try:
        found = replay_log(log, chosen, name)
    except EventLogError as error:
        raise typer.BadParameter(str(error)) from None
    directory = out or Path("out") / log.stem
    with progress() as begin:
        with whole_directory(directory) as staging:
            found.result.save(staging)
        write_pictures([found.result], directory, begin, replay=replay, figures=figures)
    if found.damage:
        typer.echo(found.damage, err=True)
    _hint_at_the_period(found)
    report_results([found.result], directory)
    print_hardware_report("controller", found.report)


def _hint_at_the_period(found: LogReplay) -> None:
    """Says so when the log's commands are not a control period apart."""
    logged, period = found.report["period"], found.result.scenario.period
    if logged is None or abs(logged - period) <= 0.1 * period:
        return
    override = f'--override "{{period: {logged:.6g}}}"'
    typer.echo(
        f"the log's commands are {1e3 * logged:.4g} ms apart, and the control period is"
        f" {1e3 * period:.4g} ms: give the scenario, and {override}",
        err=True,
    )
