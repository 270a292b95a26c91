"""The command reproduce: every figure and table of the paper."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vcbf_drake.cli.options import out_option

if TYPE_CHECKING:
    from vcbf_drake.studies.reproduction import Settings


def reproduce(
    out: Annotated[Path | None, out_option("out/reproduction")] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="A check: few trials of everything.")
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option(min=1, show_default="one a processor", help="Processes."),
    ] = None,
    only: Annotated[
        str | None,
        typer.Option(metavar="S,S,...", help="Sections, e.g. table_1; all by default."),
    ] = None,
) -> None:
    """Run everything the paper shows: numbers, figures, replays and one report.

    What DIR holds already is not run again: an interrupted command goes on.
    """
    from vcbf_drake.studies.reproduction import FULL, QUICK, SECTIONS
    from vcbf_drake.viz.report import write_report
    from vcbf_drake.viz.verdict_table import print_verdicts

    names = tuple(SECTIONS) if only is None else tuple(only.split(","))
    unknown = [name for name in names if name not in SECTIONS]
    if unknown:
        raise typer.BadParameter(
            f"no section {unknown[0]!r}; allowed: {', '.join(SECTIONS)}"
        )
    directory = out or Path("out") / ("reproduction-quick" if quick else "reproduction")
    data = _run(directory, QUICK if quick else FULL, workers, names)
    write_report(directory)
    print_verdicts(data["verdicts"])
    typer.echo(f"written to {directory}")


def _run(
    directory: Path, settings: Settings, workers: int | None, names: tuple[str, ...]
) -> dict[str, Any]:
    from vcbf_drake.studies.reproduction import reproduce as run
    from vcbf_drake.viz.terminal import progress_bar

    with progress_bar() as bar:
        task = bar.add_task("", total=1.0)

        def show(section: str, done: float) -> None:
            bar.update(task, description=section, completed=done)

        return run(directory, settings, workers or os.cpu_count() or 1, show, names)
