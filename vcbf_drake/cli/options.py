"""Arguments and options that several commands share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from vcbf_drake.simulation.scenario import Scenario

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


def out_option(default: str) -> Any:
    """Returns the option --out; `default` is what the help shows."""
    return typer.Option(
        "--out",
        metavar="DIR",
        file_okay=False,
        show_default=default,
        help="Where the results go.",
    )


def load(name_or_path: str, override: str | None, method: str | None) -> Scenario:
    """Returns the scenario with the overrides and the method of the command line."""
    from vcbf_drake.simulation.loading import load_scenario
    from vcbf_drake.simulation.scenario import validate

    scenario = load_scenario(name_or_path, override)
    if method is not None:
        scenario.method = method
        validate(scenario)
    return scenario
