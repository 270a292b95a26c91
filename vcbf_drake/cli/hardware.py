"""The commands plant, controller and replay-log: a loop over LCM, and its log."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
import math
import os
from pathlib import Path
import sys
from typing import TYPE_CHECKING, Annotated

import typer

from vcbf_drake.cli.application import complain
from vcbf_drake.cli.options import (
    MethodOption,
    OverrideOption,
    ScenarioArgument,
    load,
    out_option,
)
from vcbf_drake.cli.progress import progress
from vcbf_drake.cli.simulations import report_results, write_pictures
from vcbf_drake.environment import SIGNALS, end_at_once, handle
from vcbf_drake.files import WriterThread, json_text, whole_directory

if TYPE_CHECKING:
    from vcbf_drake.hil import Bus, ControllerProcess, LogReplay, PlantProcess
    from vcbf_drake.simulation.scenario import Scenario

# Lines that may wait for a reader of stderr, and how long at the end [s].
_MOST_LINES, _LAST_WORDS = 1000, 0.5
# Of a run without an end; it has to fit into a computer.
_MOST_TICKS = 9e6
Tell = Callable[[str], None]
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
    typer.Option(
        show_default="the scenario's",
        help="When to end, in seconds of the motion; inf for never.",
    ),
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
_SeedOption = Annotated[int, typer.Option(min=0, help="Seed of the faults.")]
_LogOption = Annotated[
    Path | None,
    typer.Option(
        "--log",
        metavar="FILE",
        dir_okay=False,
        help="Write an LCM log of what this side sends and receives.",
    ),
]
_ForceOption = Annotated[
    bool, typer.Option("--force", help="Replace a log that is there.")
]
_NameOption = Annotated[
    str | None,
    typer.Option(
        "--name",
        show_default="the scenario's",
        help="The vehicle's, with which its channels end.",
    ),
]
_WaitOption = Annotated[
    float,
    typer.Option(
        "--wait",
        min=0.0,
        show_default="for ever",
        help="How long to wait for the other side, in seconds.",
    ),
]
_TakeOverOption = Annotated[
    bool,
    typer.Option("--take-over", help="Be followed although another controller speaks."),
]
_JsonOption = Annotated[bool, typer.Option("--json", help="Print the report as JSON.")]


def plant(
    scenario: ScenarioArgument,
    override: OverrideOption = None,
    lcm_url: _UrlOption = None,
    name: _NameOption = None,
    duration: _DurationOption = None,
    rate: _RateOption = None,
    wait: _WaitOption = math.inf,
    drop: _DropOption = 0.0,
    delay: _DelayOption = 0.0,
    jitter: _JitterOption = 0.0,
    fault_seed: _SeedOption = 0,
    log: _LogOption = None,
    force: _ForceOption = False,
    as_json: _JsonOption = False,
) -> None:
    """Simulate a vehicle in real time on an LCM bus: states out, commands in.

    It stands until the first command comes. When commands cease, it falls back to what
    the scenario says, and recovers by itself. Ctrl-C ends it.

    Exit status: 0 at its end, 3 collision, 5 nobody commanded it, 128 + signal.
    """
    chosen = _load(scenario, override, None, duration, rate)
    bus = _open_bus(chosen, lcm_url, name, (drop, delay, jitter, fault_seed))
    from vcbf_drake.hil import PlantProcess

    with _telling() as tell, _logging(bus, chosen, log, force, tell):
        process = PlantProcess(chosen, bus)
        status = _run(process, "vehicle", chosen, wait, as_json, tell)
    raise typer.Exit(status)


def controller(
    scenario: ScenarioArgument,
    method: MethodOption = None,
    override: OverrideOption = None,
    lcm_url: _UrlOption = None,
    name: _NameOption = None,
    duration: _DurationOption = None,
    rate: _RateOption = None,
    wait: _WaitOption = math.inf,
    take_over: _TakeOverOption = False,
    drop: _DropOption = 0.0,
    delay: _DelayOption = 0.0,
    jitter: _JitterOption = 0.0,
    fault_seed: _SeedOption = 0,
    log: _LogOption = None,
    force: _ForceOption = False,
    as_json: _JsonOption = False,
) -> None:
    """Control a vehicle on an LCM bus: states in, commands and status out.

    It acts on every state that comes, and ends with the vehicle. When states cease, it
    holds its last command, then asks for the vehicle's fallback, and recovers by
    itself. Ctrl-C ends it; its last command asks for the fallback.

    Exit status: 0 at its end, 4 if no input was feasible then, 5 no vehicle spoke,
    128 + signal.
    """
    chosen = _load(scenario, override, method, duration, rate)
    bus = _open_bus(chosen, lcm_url, name, (drop, delay, jitter, fault_seed))
    from vcbf_drake.hil import controller_of

    with _telling() as tell, _logging(bus, chosen, log, force, tell):
        process = controller_of(chosen, bus)
        process.takes_over = take_over
        if duration is not None:
            process.duration = duration
        status = _run(process, "controller", chosen, wait, as_json, tell)
    raise typer.Exit(status)


def _load(
    scenario: str,
    override: str | None,
    method: str | None,
    duration: float | None,
    rate: float | None,
) -> Scenario:
    for number in SIGNALS:  # Until a process can say farewell: one line.
        handle(number, end_at_once)
    from vcbf_drake.simulation.scenario import validate

    chosen = load(scenario, override, method)
    if rate is not None:
        chosen.period = 1.0 / rate
    if duration is not None:
        longest = _MOST_TICKS * chosen.period
        chosen.duration = longest if math.isinf(duration) else duration
    validate(chosen)
    return chosen


def _open_bus(
    scenario: Scenario,
    url: str | None,
    name: str | None,
    faults: tuple[float, float, float, int],
) -> Bus:
    from vcbf_drake.errors import InvalidValueError
    from vcbf_drake.hil import DEFAULT_URL, BusError, LinkFaults, open_bus

    try:
        return open_bus(scenario, url or DEFAULT_URL, name, LinkFaults(*faults))
    except InvalidValueError as error:
        raise typer.BadParameter(str(error)) from None
    except BusError as error:
        complain(str(error))
        raise typer.Exit(1) from None


@contextmanager
def _logging(
    bus: Bus, scenario: Scenario, path: Path | None, force: bool, tell: Tell
) -> Iterator[None]:
    """Logs all messages of the bus, if requested."""
    if path is None:
        yield
        return
    from vcbf_drake.hil import EventLogError, carries_scenario, start_log

    try:
        log = start_log(bus, scenario, path, force=force)
    except EventLogError as error:
        raise typer.BadParameter(str(error)) from None
    try:
        with log:
            yield
    finally:
        tell(f"log written to {log.path}")
        if not carries_scenario(scenario):
            tell(f"its vehicle is your own: vcbf-drake replay-log {log.path} SCENARIO")
        if log.failure:
            tell(log.failure)


def _write_line(line: str) -> None:
    with suppress(OSError):  # Not sys.stderr, whose lock would block the end.
        os.write(2, f"{line}\n".encode())


def _telling() -> closing[WriterThread[str]]:
    """Lines on stderr, from a thread of its own.

    A reader that stalls or ends loses lines, but does not stop the run.
    """
    return closing(WriterThread(_write_line, _MOST_LINES, _LAST_WORDS))


def _run(
    process: PlantProcess | ControllerProcess,
    side: str,
    scenario: Scenario,
    patience: float,
    as_json: bool,
    tell: Tell,
) -> int:
    """Runs a process and returns the exit status of its ending."""
    from vcbf_drake.hil import EXIT_STATUSES
    from vcbf_drake.viz.terminal import print_hardware_report

    signals: list[int] = []

    def stop(number: int, *_: object) -> None:
        signals.append(number)
        process.stop()

    for number in SIGNALS:
        handle(number, stop)
    bus = process.bus
    called = f"as {bus.name}" if bus.name else "without a name"
    tell(f"{side} of {scenario.name} on {bus.lcm.get_lcm_url()} {called}")
    process.tell = lambda line: tell(f"{side}: {line}")
    if sys.stderr.isatty():
        process.progress = tell
    process.run(patience)
    report = {"scenario": scenario.name, "ending": process.ending, **process.report()}
    try:
        if as_json:
            typer.echo(json_text(report), nl=False)
        else:
            print_hardware_report(side, report)
    except OSError:  # The terminal is gone: what is still to be flushed goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return EXIT_STATUSES[process.ending] + (signals[0] if signals else 0)


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
