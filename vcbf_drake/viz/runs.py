"""Runs for pictures: a result with its label, colour and events."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import dataclasses
from dataclasses import dataclass
from functools import cached_property
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from vcbf_drake.barriers import Barrier, StateLimit
from vcbf_drake.checks import Array
from vcbf_drake.plants.vehicle import Channels, channels_of
from vcbf_drake.safety.settings import METHODS
from vcbf_drake.viz.solids import in_space
from vcbf_drake.viz.style import METHOD_STYLES, VEHICLE_COLORS

if TYPE_CHECKING:
    from vcbf_drake.plants.vehicle import Vehicle
    from vcbf_drake.simulation.result import Result
    from vcbf_drake.simulation.scenario import Scenario
    from vcbf_drake.simulation.sections import InputLimits


@dataclass(frozen=True)
class Event:
    """An event that changes the description of a run from then on.

    Attributes:
        time: When it happened [s].
        kind: ``infeasible``, ``collision``, ``reached`` or ``timeout``.
        text: The event in words.
    """

    time: float
    kind: str
    text: str


@dataclass(frozen=True)
class Drawn:
    """The data of a motion for pictures, from any source.

    Attributes:
        label: A name that no other one in the picture has.
        color: A hexadecimal colour.
        dashes: On and off lengths [points]; empty for a solid line.
        ghost: Whether another one of the same vehicle is to be brought out.
        events: The events in the order of time.
        time: The control ticks, shape (T,) [s].
        log: The arrays of a `Result`'s log.
        inputs: The inputs' names with units.
        limits: The inputs' limits; None where the log has no filter's arrays.
        has_volume: Whether the method has a volume row.
    """

    label: str
    color: str
    dashes: tuple[float, ...]
    ghost: bool
    events: Sequence[Event]
    time: Array
    log: Mapping[str, Array]
    inputs: Sequence[str]
    limits: InputLimits | None
    has_volume: bool

    @property
    def least_barrier(self) -> Array:
        """The least barrier at every tick, shape (T,); nan where there is none."""
        values = np.asarray(self.log["barriers"], dtype=float)
        least = np.min(values, axis=1, initial=np.inf, where=np.isfinite(values))
        return np.where(np.isfinite(least), least, np.nan)


@dataclass(frozen=True)
class Run(Drawn):
    """A result of a scenario and how it is drawn.

    Attributes:
        result: The result.
        name: The vehicle's, where there are several.
    """

    result: Result
    name: str = ""

    @property
    def scenario(self) -> Scenario:
        """The scenario of the run."""
        return self.result.scenario

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle of the run."""
        return self.scenario.vehicle

    @cached_property
    def channels(self) -> Channels:
        """The names of the plant's states and inputs."""
        return channels_of(self.vehicle.make_plant())

    @property
    def is_flat(self) -> bool:
        """Whether the vehicle moves in the plane."""
        return len(self.scenario.target) == 2

    @cached_property
    def path(self) -> Array:
        """The vehicle's position at every tick, shape (T, 3) [m]."""
        return in_space(self.vehicle.positions(self.log["state"]))

    @property
    def target(self) -> Array:
        """The target position, shape (3,) [m]."""
        return in_space(self.scenario.target)

    @property
    def failure(self) -> Event | None:
        """The first infeasible tick or collision, whichever came first."""
        failures = (e for e in self.events if e.kind in ("infeasible", "collision"))
        return next(failures, None)

    @property
    def caption(self) -> str:
        """The label, with how the run failed if it did."""
        if self.failure is None:
            return self.label
        return f"{self.label}: {self.failure.text}"

    @property
    def failure_tick(self) -> int | None:
        """The first tick that is not before the failure; the last if there is none."""
        if self.failure is None:
            return None
        tick = int(np.searchsorted(self.time, self.failure.time - 1e-9))
        return min(tick, len(self.time) - 1)

    def line(self, **options: Any) -> dict[str, Any]:
        """The keyword arguments that draw this run as a matplotlib line."""
        style: dict[str, Any] = {"color": self.color, "label": self.label}
        if self.dashes:
            style["dashes"] = self.dashes
        return style | options


def barrier_unit(scenario: Scenario) -> str:
    """The unit of a scenario's barriers: metres, say; empty where they have several."""
    length = "m²" if scenario.barrier.form == "squared" else "m"
    states = channels_of(scenario.vehicle.make_plant()).states
    units = {
        states[str(each.state)] if isinstance(each, StateLimit) else length
        for each in scenario.obstacles
    }
    if any(isinstance(each, Barrier) for each in scenario.vehicle.barriers()):
        units.add("")  # Of the robot's own: joints, speeds.
    return units.pop() if len(units) == 1 else ""


def label_runs(results: Sequence[Result]) -> list[Run]:
    """Gives every result a label, a colour and dashes of its own.

    Runs of one method share its hue, from light to the method's own colour, and are
    told apart by the scenario entries that differ between them. Where there are several
    vehicles, which their scenarios' names tell, each has a hue of its own.

    Args:
        results: The results, the one to bring out last.

    Raises:
        ValueError: There is no result.
    """
    if not results:
        raise ValueError("results: got none; at least one is needed")
    names = dict.fromkeys(result.scenario.name for result in results)
    hues = dict(zip(names, cycle(VEHICLE_COLORS), strict=False))
    return [_run(results, number, hues) for number in range(len(results))]


def _run(results: Sequence[Result], number: int, hues: Mapping[str, str]) -> Run:
    """One of several results as a run, among vehicles of these hues."""
    scenarios = [result.scenario for result in results]
    name, method = scenarios[number].name, scenarios[number].method
    own = [k for k, each in enumerate(scenarios) if each.name == name]
    same = [k for k in own if scenarios[k].method == method]
    rank, ghost, style = same.index(number), number != own[-1], METHOD_STYLES[method]
    label, dashes = style.label, style.dashes
    color = _tint(style.color, 0.6 * (1.0 - (rank + 1) / len(same)))
    if len(same) > 1:
        label += f", {_differences([scenarios[k] for k in same])[rank]}"
    if len(hues) > 1:
        label, dashes = (f"{name}, {label}", dashes) if len(own) > 1 else (name, ())
        color = _tint(hues[name], 0.5) if ghost else hues[name]
    result = results[number]
    return Run(
        label,
        color,
        dashes,
        ghost,
        events=sorted(_events(result.summary), key=lambda event: event.time),
        time=np.asarray(result.log["time"], dtype=float),
        log=result.log,
        inputs=channels_of(result.scenario.vehicle.make_plant()).input_labels,
        limits=result.scenario.input_set,
        has_volume=METHODS[method].has_volume_row,
        result=result,
        name=name if len(hues) > 1 else "",
    )


def _events(summary: Mapping[str, Any]) -> Iterator[Event]:
    for kind, key, words in (
        ("infeasible", "infeasible_at", "infeasible since"),
        ("collision", "collided_at", "collision at"),
        ("reached", "reached_at", "reached at"),
    ):
        if summary[key] is not None:
            time = float(summary[key])
            yield Event(time, kind, f"{words} {time:.1f} s")
    if summary["outcome"] == "timeout":
        distance = f"{summary['final_distance']:.1f} m from the target"
        yield Event(float(summary["running_time"]), "timeout", f"ended {distance}")


def _differences(scenarios: Sequence[Any]) -> list[str]:
    """The differences of each scenario from the others, such as ``k_p = 0.4``."""
    entries = [dict(_entries(scenario)) for scenario in scenarios]
    keys = dict.fromkeys(key for each in entries for key in each)
    words = [
        [f"{key.split('.')[-1]} = {each.get(key)}" for each in entries]
        for key in keys
        if key != "description" and len({str(each.get(key)) for each in entries}) > 1
    ]
    numbers = [f"run {index + 1}" for index in range(len(entries))]
    return [*map(", ".join, zip(*(words[:2] or [numbers]), strict=True))]


def _entries(value: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The leaves of nested dataclasses, as dotted names and values."""
    for field in dataclasses.fields(value):
        name, entry = prefix + field.name, getattr(value, field.name)
        nested = dataclasses.is_dataclass(entry)
        yield from _entries(entry, f"{name}.") if nested else [(name, entry)]


def _tint(color: str, amount: float) -> str:
    """A hexadecimal colour mixed with white."""
    channels = bytes.fromhex(color.removeprefix("#"))
    return "#" + bytes(round(c + amount * (255 - c)) for c in channels).hex()
