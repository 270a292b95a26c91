"""Runs as pictures know them: a result, its label, its colour, and what happened."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import dataclasses
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from vcbf_drake.barriers import Barrier, StateLimit
from vcbf_drake.checks import Array
from vcbf_drake.plants.channels import Channels, channels_of
from vcbf_drake.viz.solids import in_space
from vcbf_drake.viz.style import METHOD_STYLES, VEHICLE_COLORS

if TYPE_CHECKING:
    from vcbf_drake.plants.vehicle import Vehicle
    from vcbf_drake.simulation.result import Result
    from vcbf_drake.simulation.scenario import Scenario
    from vcbf_drake.simulation.sections import InputLimits


@dataclass(frozen=True)
class Event:
    """Something that changes how a run is described from then on.

    Attributes:
        time: When it happened [s].
        kind: ``infeasible``, ``collision``, ``reached`` or ``timeout``.
        text: What happened, in words.
    """

    time: float
    kind: str
    text: str


@dataclass(frozen=True)
class Drawn:
    """What pictures have to know of a motion, whatever it comes from.

    Attributes:
        label: A name that no other one in the picture has.
        color: A hexadecimal colour.
        dashes: On and off lengths [points]; empty for a solid line.
        ghost: Whether another one of the same vehicle is to be brought out.
        events: What happened, in the order it happened.
        time: The control ticks, shape (T,) [s].
        log: The arrays of a `Result`'s log.
        inputs: The inputs' names with units.
        limits: The inputs' limits; None where the log has no filter's arrays.
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
        """What was run."""
        return self.result.scenario

    @property
    def vehicle(self) -> Vehicle:
        """Who moved."""
        return self.scenario.vehicle

    @cached_property
    def channels(self) -> Channels:
        """What the plant's states and inputs are called."""
        return channels_of(self.vehicle.make_plant())

    @property
    def is_flat(self) -> bool:
        """Whether the vehicle moves in the plane."""
        return len(self.scenario.target) == 2

    @cached_property
    def path(self) -> Array:
        """Where the vehicle is at every tick, shape (T, 3) [m]."""
        return in_space(self.vehicle.positions(self.log["state"]))

    @property
    def target(self) -> Array:
        """Where it is to go, shape (3,) [m]."""
        return in_space(self.scenario.target)

    @property
    def least_barrier(self) -> Array:
        """The least barrier at every tick, shape (T,); nan where there is none."""
        return least_barrier(self.log)

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


def least_barrier(log: Mapping[str, Array]) -> Array:
    """The least barrier at every tick of a log, shape (T,); nan where there is none."""
    values = np.asarray(log["barriers"], dtype=float)
    least = np.min(values, axis=1, initial=np.inf, where=np.isfinite(values))
    return np.where(np.isfinite(least), least, np.nan)


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
    names = [result.scenario.name for result in results]
    hues = dict(zip(dict.fromkeys(names), cycle(VEHICLE_COLORS), strict=False))
    runs = []
    for index, name in enumerate(names):
        own = [result for result in results if result.scenario.name == name]
        run = _one_of(own, names[:index].count(name))
        if len(hues) > 1:
            run = _of_vehicle(run, name, hues[name], own)
        runs.append(run)
    return runs


def _one_of(own: Sequence[Result], index: int) -> Run:
    """One of the results of a vehicle as a run."""
    methods = [result.scenario.method for result in own]
    method = methods[index]
    style = METHOD_STYLES[method]
    same, rank = methods.count(method), methods[:index].count(method)
    label = style.label
    if same > 1:
        label += f", {_differences([result.scenario for result in own])[index]}"
    color = _tint(style.color, 0.6 * (1.0 - (rank + 1) / same))
    result = own[index]
    return Run(
        label,
        color,
        style.dashes,
        ghost=index + 1 < len(own),
        events=sorted(_events(result.summary), key=lambda event: event.time),
        time=np.asarray(result.log["time"], dtype=float),
        log=result.log,
        inputs=channels_of(result.scenario.vehicle.make_plant()).input_labels,
        limits=result.scenario.input_set,
        result=result,
    )


def _of_vehicle(run: Run, name: str, hue: str, own: Sequence[Result]) -> Run:
    """The run with its vehicle's name and hue, which is paler for a ghost."""
    if len(own) == 1:
        return replace(run, label=name, color=hue, dashes=(), name=name)
    color = _tint(hue, 0.5) if run.ghost else hue
    return replace(run, label=f"{name}, {run.label}", color=color, name=name)


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
    """What tells each scenario from the others, such as ``k_p = 0.4``."""
    entries = [dict(_entries(scenario)) for scenario in scenarios]
    keys = dict.fromkeys(key for entry in entries for key in entry)
    ignored = {"method", "name", "description"}
    varying = [
        key
        for key in keys
        if key not in ignored and len({str(entry.get(key)) for entry in entries}) > 1
    ]
    if not varying:
        return [f"run {index + 1}" for index in range(len(entries))]
    return [
        ", ".join(f"{key.split('.')[-1]} = {entry.get(key)}" for key in varying[:2])
        for entry in entries
    ]


def _entries(value: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The leaves of nested dataclasses, as dotted names and values."""
    for field in dataclasses.fields(value):
        name, entry = prefix + field.name, getattr(value, field.name)
        if dataclasses.is_dataclass(entry):
            yield from _entries(entry, name + ".")
        else:
            yield name, entry


def _tint(color: str, amount: float) -> str:
    """A hexadecimal colour mixed with white."""
    channels = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return "#" + "".join(f"{round(c + amount * (255 - c)):02x}" for c in channels)
