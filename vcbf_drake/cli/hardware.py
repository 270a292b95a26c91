"""The commands plant and controller: the two halves of a loop over LCM."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import json
from pathlib import Path
import signal
from typing import TYPE_CHECKING, Annotated

import typer

from vcbf_drake.cli.options import (
    MethodOption,
    OverrideOption,
    ScenarioArgument,
    load,
)
from vcbf_drake.cli.outputs import plain_json

if TYPE_CHECKING:
    from vcbf_drake.hil import Bus, ControllerProcess, PlantProcess
    from vcbf_drake.simulation.scenario import Scenario

_UrlOption = Annotated[
    str | None,
    typer.Option(
        "--lcm-url",
        metavar="URL",
        show_default="udpm://239.255.76.67:7667?ttl=0",
        help="The bus; by default it stays on this computer.",
    ),
]
_DurationOption = Annotated[
    float | None,
    typer.Option(show_default="the scenario's", help="When to end, in seconds."),
]
_RateOption = Annotated[
    float | None,
    typer.Option(min=1.0, show_default="the scenario's", help="Messages a second."),
]
_DropOption = Annotated[
    float,
    typer.Option(min=0.0, max=1.0, help="Fault: share of arrivals that are lost."),
]
_DelayOption = Annotated[
    float, typer.Option(min=0.0, help="Fault: seconds that every arrival is late.")
]
_JitterOption = Annotated[
    float, typer.Option(min=0.0, help="Fault: the delay varies by as many seconds.")
]
_LogOption = Annotated[
    Path | None,
    typer.Option(
        "--log",
        metavar="FILE",
        dir_okay=False,
        help="Write an LCM log of what this side sends and receives.",
    ),
]
_PredictOption = Annotated[
    bool | None,
    typer.Option(
        "--predict/--no-predict",
        show_default="the scenario's",
        help="Act on the state predicted over the link's delays.",
    ),
]
_JsonOption = Annotated[bool, typer.Option("--json", help="Print the report as JSON.")]
_SeedOption = Annotated[int, typer.Option(min=0, help="Seed of the faults.")]


def plant(
    scenario: ScenarioArgument,
    override: OverrideOption = None,
    lcm_url: _UrlOption = None,
    duration: _DurationOption = None,
    rate: _RateOption = None,
    drop: _DropOption = 0.0,
    delay: _DelayOption = 0.0,
    jitter: _JitterOption = 0.0,
    fault_seed: _SeedOption = 0,
    log: _LogOption = None,
    as_json: _JsonOption = False,
) -> None:
    """Simulate a vehicle in real time on an LCM bus: states out, commands in.

    It stands until the first command comes. When commands cease, it falls back to what
    the scenario says, and recovers by itself. Ctrl-C ends it.
    """
    chosen = _load(scenario, override, None, duration, rate)
    bus = _open_bus(lcm_url, drop, delay, jitter, fault_seed)
    from vcbf_drake.hil import PlantProcess

    with _logging(bus, chosen, log):
        _run(PlantProcess(chosen, bus), "vehicle", as_json)


def controller(
    scenario: ScenarioArgument,
    method: MethodOption = None,
    override: OverrideOption = None,
    lcm_url: _UrlOption = None,
    duration: _DurationOption = None,
    rate: _RateOption = None,
    drop: _DropOption = 0.0,
    delay: _DelayOption = 0.0,
    jitter: _JitterOption = 0.0,
    fault_seed: _SeedOption = 0,
    predict: _PredictOption = None,
    log: _LogOption = None,
    as_json: _JsonOption = False,
) -> None:
    """Control a vehicle on an LCM bus: states in, commands and status out.

    It acts on every state that comes, and ends with the vehicle. When states cease, it
    holds its last command, then asks for the vehicle's fallback, and recovers by
    itself. Ctrl-C ends it; its last command asks for the fallback.
    """
    chosen = _load(scenario, override, method, duration, rate)
    if predict is not None:
        chosen.hardware.predict = predict
    bus = _open_bus(lcm_url, drop, delay, jitter, fault_seed)
    from vcbf_drake.hil import ControllerProcess

    with _logging(bus, chosen, log):
        _run(ControllerProcess(chosen, bus), "controller", as_json)


def _load(
    scenario: str,
    override: str | None,
    method: str | None,
    duration: float | None,
    rate: float | None,
) -> Scenario:
    from vcbf_drake.simulation.scenario import validate

    chosen = load(scenario, override, method)
    if duration is not None:
        chosen.duration = duration
    if rate is not None:
        chosen.period = 1.0 / rate
    validate(chosen)
    return chosen


def _open_bus(
    url: str | None, drop: float, delay: float, jitter: float, seed: int
) -> Bus:
    from pydrake.lcm import DrakeLcm

    from vcbf_drake.hil import DEFAULT_URL, Bus, LinkFaults, check_bus

    try:
        faults = LinkFaults(drop, delay, jitter, seed)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
    check_bus(url or DEFAULT_URL)
    return Bus(DrakeLcm(url or DEFAULT_URL), faults=faults)


@contextmanager
def _logging(bus: Bus, scenario: Scenario, path: Path | None) -> Iterator[None]:
    """Logs what the bus sends and receives, if that is wanted."""
    if path is None:
        yield
        return
    from vcbf_drake.hil import EventLogError, start_log

    try:
        log = start_log(bus, scenario, path)
    except EventLogError as error:
        raise typer.BadParameter(str(error)) from None
    with log:
        yield
    typer.echo(log.failure or f"log written to {path}", err=True)


def _run(process: PlantProcess | ControllerProcess, side: str, as_json: bool) -> None:
    from vcbf_drake.viz.hardware_report import print_hardware_report

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, process.stop)
    url = process.bus.lcm.get_lcm_url()
    typer.echo(f"{side} of {process.scenario.name} on {url}", err=True)
    process.run()
    if as_json:
        typer.echo(json.dumps(plain_json(process.report()), indent=2))
    else:
        print_hardware_report(side, process.report())
