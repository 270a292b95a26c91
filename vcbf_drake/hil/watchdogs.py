"""Watchdogs of the controller: old states, other obstacles, obstacles not perceived."""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Any, NamedTuple, Protocol

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    LeafSystem,
    State,
)

from vcbf_drake.barriers import PerceivedSpheres
from vcbf_drake.hil.bus import Bus, Clock
from vcbf_drake.hil.decoding import CommandMode, Reason, obstacles_format
from vcbf_drake.hil.mailbox import Inbox
from vcbf_drake.simulation.scenario import Hardware, Scenario


class Verdict(NamedTuple):
    """What to ask of the vehicle, and why; the reason is empty with APPLY."""

    mode: CommandMode
    reason: str


class Watchdog(Protocol):
    """What may ask for a vehicle's fallback."""

    def verdict(self) -> Verdict:
        """Returns what to ask of the vehicle now, and why."""


class StateWatchdog:
    """Looks at the age of the newest state.

    A state older than `Hardware.max_state_age` is not acted on: the last command is
    held for `Hardware.hold_time`, then the vehicle has to use its own fallback, until a
    state comes again.

    Args:
        states: The states that came.
        clock: Tells the time.
        settings: How old is too old.
    """

    def __init__(self, states: Inbox, clock: Clock, settings: Hardware) -> None:
        self._states, self._clock, self._settings = states, clock, settings

    def state_age(self) -> float:
        """Returns the age of the newest state [s], infinite before the first."""
        if self._states.newest is None:
            return math.inf
        measured = self._states.utime(self._states.newest.utime_measured)
        return 1e-6 * (self._clock.utime() - measured)

    def verdict(self) -> Verdict:
        """Returns what to ask of the vehicle now."""
        age, limit = self.state_age(), self._settings.max_state_age
        if age <= limit:
            return Verdict(CommandMode.APPLY, "")
        if age <= limit + self._settings.hold_time:
            reason = f"the state is {age:.2f} s old; the input is held"
            return Verdict(CommandMode.HOLD, reason)
        if math.isinf(age):
            return Verdict(CommandMode.FALLBACK, "no state yet")
        return Verdict(CommandMode.FALLBACK, f"no new state for {age:.2f} s")


# Obstacles -------------------------------------------------------------------------


def _inbox(
    bus: Bus,
    max_age: float,
    on_accept: Callable[[Any, int], None],
    vehicle: Inbox,
    settings: Hardware,
) -> Inbox:
    """Returns an inbox for what the vehicle says whose states come into another one."""

    def refusal(message: Any) -> Reason | None:
        is_another = vehicle.newest is not None and not vehicle.has_same_sender(message)
        return Reason.SESSION if is_another else None

    return Inbox(
        bus,
        obstacles_format(),
        max_age,
        on_accept,
        silence=0.0,  # Whom to follow is decided by the states alone.
        max_clock_offset=settings.max_clock_offset,
        refusal=refusal,
    )


_TOLERANCE = 0.01  # [m]
_MAX_AGE = 1.0  # [s]


class ObstacleWatch:
    """Compares the obstacles that a vehicle publishes with those of the scenario.

    A vehicle that publishes none is not checked. Another number of them is a
    difference too, until as many as are known come again.

    Args:
        bus: Where they come from.
        scenario: What the controller knows.
        vehicle: The states of the vehicle that publishes them.

    Attributes:
        inbox: What arrived.
    """

    def __init__(self, bus: Bus, scenario: Scenario, vehicle: Inbox) -> None:
        self._difference = ""
        self._obstacles = scenario.spheres
        self._shape = len(scenario.spheres), len(scenario.target)
        self._vehicle = vehicle
        self.inbox = _inbox(bus, _MAX_AGE, self._compare, vehicle, scenario.hardware)

    def verdict(self) -> Verdict:
        """Returns what to ask of the vehicle now."""
        if self._difference and self._vehicle.has_same_sender(self.inbox.newest):
            return Verdict(CommandMode.FALLBACK, self._difference)
        return Verdict(CommandMode.APPLY, "")

    def _compare(self, message: Any, now: int) -> None:
        count, dimensions = self._shape
        self._difference = ""
        sizes = message.num_obstacles, message.num_coordinates
        if sizes != (count, count * dimensions):
            self._difference = f"the vehicle does not know of {count} obstacles"
            return
        centers = np.reshape(message.position, self._shape)
        for number, (obstacle, center, radius) in enumerate(
            zip(self._obstacles, centers, message.radius, strict=True), start=1
        ):
            away = float(np.linalg.norm(center - obstacle.center_at(message.time)))
            larger = radius - obstacle.safety_distance
            if away + abs(larger) > _TOLERANCE:
                self._difference = (
                    f"the vehicle's obstacle {number} is {away:.3f} m away from the"
                    f" scenario's and {larger:+.3f} m larger"
                )
                return


class ObstacleReceiver(LeafSystem):
    """The obstacles that a vehicle perceives, for the filter's port ``obstacles``.

    .. pydrake_system::

        name: ObstacleReceiver
        output_ports:
        - obstacles

    Their number may change from message to message. Between two messages each keeps
    its velocity. Too many of them, none for `Hardware.max_obstacle_age`, or malformed
    ones: the port keeps what came last, and the verdict asks for the vehicle's
    fallback.

    Args:
        bus: Where they come from.
        spheres: What describes them; it has room for so many.
        vehicle: The states of the vehicle that perceives them: what another one
            perceives is not taken.
        settings: How old they may be.

    Attributes:
        inbox: What arrived.
    """

    def __init__(
        self,
        bus: Bus,
        spheres: PerceivedSpheres,
        vehicle: Inbox,
        settings: Hardware | None = None,
    ) -> None:
        super().__init__()
        settings = settings or Hardware()
        self._bus, self._spheres, self._vehicle = bus, spheres, vehicle
        self._max_age = settings.max_obstacle_age
        self.inbox = _inbox(bus, self._max_age, self._take, vehicle, settings)
        self._trouble = ""
        self._packed = np.zeros(1 + spheres.size)
        # The vehicle's time of the message, then the slots.
        self.DeclareDiscreteState(self._packed)
        self.DeclarePerStepUnrestrictedUpdateEvent(self._take_over)
        self.DeclareForcedUnrestrictedUpdateEvent(self._take_over)
        self.DeclareVectorOutputPort("obstacles", spheres.size, self._calc)

    def verdict(self) -> Verdict:
        """Returns what to ask of the vehicle now."""
        now = self._bus.clock.utime()
        if not self._vehicle.has_same_sender(self.inbox.newest):
            reason = "no obstacles have been perceived yet"
        elif now - self.inbox.received_at > 1e6 * self._max_age:
            age = 1e-6 * (now - self.inbox.received_at)
            reason = f"no obstacles have been perceived for {age:.2f} s"
        else:
            reason = self._trouble
        if not reason:
            return Verdict(CommandMode.APPLY, "")
        complaint = self.inbox.complaint(now)
        words = f"{reason}; {complaint}" if complaint else reason
        return Verdict(CommandMode.FALLBACK, words)

    def _take(self, message: Any, now: int) -> None:
        seen = np.array(message.valid, dtype=bool)
        k = self._spheres.dimensions
        if message.num_coordinates != k * len(seen):
            self._trouble = (
                f"the {len(seen)} obstacles that are perceived have"
                f" {message.num_coordinates} coordinates; it must be {k} each"
            )
            return
        if seen.sum() > self._spheres.capacity:
            self._trouble = (
                f"{seen.sum()} obstacles are perceived, and there is room for"
                f" {self._spheres.capacity} (hardware.most_obstacles)"
            )
            return
        radii = np.array(message.radius)[seen]
        if np.any(radii < 0.0):
            self._trouble = "an obstacle that is perceived has a negative radius"
            return
        centers = np.reshape(message.position, (-1, k))[seen]
        velocities = np.reshape(message.velocity, (-1, k))[seen]
        slots = self._spheres.pack(centers, velocities, radii)
        self._packed, self._trouble = np.append(message.time, slots), ""

    def _take_over(self, context: Context, state: State) -> EventStatus:
        self._bus.poll()
        state.get_mutable_discrete_state().set_value(self._packed)
        return EventStatus.Succeeded()

    def _calc(self, context: Context, output: BasicVector) -> None:
        time, *slots = context.get_discrete_state_vector().CopyToVector()
        k = self._spheres.dimensions
        table = np.reshape(slots, (self._spheres.capacity, -1))
        # To where they are by now; time that went back is a motion that began anew.
        table[:, :k] += max(0.0, context.get_time() - time) * table[:, k : 2 * k]
        output.SetFromVector(table.ravel())
