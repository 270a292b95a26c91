"""Arguments and options that several commands share."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from vcbf_drake.simulation.fleet import Fleet
    from vcbf_drake.simulation.scenario import Scenario

# Those of `vcbf_drake.safety.METHODS`, which --help must not import; a test compares.
METHODS = (
    "cbf-qp, robust-cbf-qp, wang-xu-dob-cbf-qp, vcbf-qp, dob-cbf-qp, dob-vcbf-qp,"
    " optimal-decay, backup"
)

ScenarioArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="A shipped scenario (vcbf-drake list), a YAML file or a Python file.",
    ),
]
ScenarioNameOption = Annotated[
    str | None,
    typer.Option(
        "--scenario-name",
        metavar="NAME",
        help="Which scenario of a file that holds several.",
    ),
]
MethodOption = Annotated[
    str | None,
    typer.Option("--method", metavar="M", help=f"Safety filter: {METHODS}."),
]
OverrideOption = Annotated[
    str | None,
    typer.Option(
        "--override",
        metavar="YAML",
        help="Values that replace the scenario's, e.g. '{duration: 5}'.",
    ),
]


def _writable(directory: Path | None) -> Path | None:
    """Refuses a directory that cannot be made, before hours are spent for it."""
    if directory is not None:
        there = next(each for each in (directory, *directory.parents) if each.exists())
        if not (there.is_dir() and os.access(there, os.W_OK)):
            raise typer.BadParameter(f"{there} is no directory that one may write to")
    return directory


def out_option(default: str) -> Any:
    """Returns the option --out; `default` is what the help shows."""
    return typer.Option(
        "--out",
        metavar="DIR",
        file_okay=False,
        callback=_writable,
        show_default=default,
        help="Where the results go.",
    )


def method_names(text: str) -> list[str]:
    """Returns the methods of a list with commas, each once."""
    return list(dict.fromkeys(name.strip() for name in text.split(",")))


def load(
    name_or_path: str,
    override: str | None,
    method: str | None,
    scenario_name: str | None = None,
) -> Scenario:
    """Returns a scenario of one vehicle, as the command line has it."""
    fleet = load_vehicles(name_or_path, override, method, scenario_name)
    return fleet.only(name_or_path)


def load_vehicles(
    name_or_path: str,
    override: str | None,
    method: str | None,
    scenario_name: str | None = None,
) -> Fleet:
    """Returns the vehicles with the overrides and the method of the command line."""
    from vcbf_drake.simulation.loading import load_fleet

    fleet = load_fleet(name_or_path, override, scenario_name)
    if method is not None:
        fleet.set_method(method)
    return fleet
