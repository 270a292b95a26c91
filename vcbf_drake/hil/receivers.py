"""Receivers of a vehicle's messages: its state and its perceived obstacles."""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Any, NamedTuple

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    LeafSystem,
    State,
)

from vcbf_drake.barriers import PerceivedSpheres
from vcbf_drake.checks import Array
from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.formats import (
    CommandMode,
    Reason,
    VehicleMode,
    obstacles_format,
    state_format,
)
from vcbf_drake.hil.inbox import Inbox
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.sections import Hardware

# The time that a vehicle may take to follow a controller that it hears first [us].
_TO_SETTLE = 300_000


class Verdict(NamedTuple):
    """A request to the vehicle, and its reason."""

    mode: CommandMode
    reason: str = ""


# A function that may request a vehicle's fallback.
Watchdog = Callable[[], Verdict]


class StateStamp(NamedTuple):
    """The identity of a state, from its message.

    Attributes:
        moves: 1 if the vehicle is under way, because it follows, falls back, or has
            accepted a command; else 0.
    """

    session: float
    sequence: float
    utime: float
    time: float
    moves: float


class StateReceiver(LeafSystem):
    """Takes the place of a plant: its outputs are the vehicle's last message.

    | port | size | |
    | --- | --- | --- |
    | ``state`` | n | the newest measured state; zeros before the first |
    | ``applied_input`` | m | the mean input applied since the previous state |
    | ``stamp`` | 5 | the `StateStamp` of that state; nan before the first |
    | ``delays`` | 2 | those of the state, and of the last command it echoes [s] |

    Messages are taken over at the beginning of a simulator's step, or at a forced
    event. `verdict` is a `Watchdog`: a state older than `Hardware.max_state_age` is not
    acted on. The last command is held for `Hardware.hold_time`, then the vehicle has to
    use its own fallback, until a state comes again.

    Args:
        bus: The bus of the states.
        num_states: n.
        num_inputs: m.
        settings: The greatest age of a state, and the silence of a vehicle after which
            another one of its name is controlled in its place.

    Attributes:
        inbox: The inbox of the states.
    """

    def __init__(
        self,
        bus: Bus,
        num_states: int,
        num_inputs: int,
        settings: Hardware | None = None,
    ) -> None:
        super().__init__()
        self._bus, self._settings = bus, (settings := settings or Hardware())
        self.inbox = Inbox(
            bus,
            state_format(num_states, num_inputs),
            settings.max_state_age,
            silence=settings.max_state_age + settings.hold_time,
            max_clock_offset=settings.max_clock_offset,
            echo=self._echo,
        )
        self.DeclarePerStepUnrestrictedUpdateEvent(self._take_over)
        self.DeclareForcedUnrestrictedUpdateEvent(self._take_over)
        for name, initial in (
            ("state", np.zeros(num_states)),
            ("applied_input", np.zeros(num_inputs)),
            ("stamp", np.full(len(StateStamp._fields), math.nan)),
            ("delays", np.zeros(2)),
        ):
            self.DeclareStateOutputPort(name, self.DeclareDiscreteState(initial))
        self._integral = self.DeclareDiscreteState(num_inputs)

    def stamp(self, context: Context) -> StateStamp:
        """Returns the stamp of the state at the outputs; nan before the first."""
        return StateStamp(*self.GetOutputPort("stamp").Eval(context).tolist())

    def has_news(self, context: Context) -> bool:
        """Returns whether a newer message has arrived than that at the outputs."""
        shown, newest = self.stamp(context), self.inbox.newest
        return newest is not None and ((newest.session, newest.sequence) != shown[:2])

    @property
    def is_followed(self) -> bool:
        """Whether the vehicle follows our commands, by its last state."""
        newest = self.inbox.newest
        return newest is not None and newest.command_session == self._bus.session

    def follows_another(self, within: float) -> bool:
        """Returns whether it applies another's command of less than this age [s]."""
        newest = self.inbox.newest
        if newest is None or not 0 < newest.command_session != self._bus.session:
            return False
        is_recent = newest.command_age < 1e6 * within
        return bool(newest.mode == VehicleMode.FOLLOWING and is_recent)

    def notice(self) -> str:
        """Returns why no vehicle follows, or other senders; empty for neither."""
        newest, now = self.inbox.newest, self._bus.clock.utime()
        is_settled = now - self.inbox.followed_since > _TO_SETTLE
        if newest is not None and is_settled and not self.is_followed:
            if newest.command_session <= 0:
                return "the vehicle tells of no command that it has accepted"
            return f"the vehicle follows another controller, {newest.command_session}"
        is_recent = now - self.inbox.last_rejected_at < 1_000_000
        if is_recent and self.inbox.last_rejection == Reason.SESSION.value:
            return "another vehicle of this name speaks and is not controlled"
        return ""

    def state_age(self) -> float:
        """Returns the age of the newest state [s], infinite before the first."""
        newest = self.inbox.newest
        if newest is None:
            return math.inf
        measured = self.inbox.utime(newest.utime_measured)
        return 1e-6 * (self._bus.clock.utime() - measured)

    def verdict(self) -> Verdict:
        """Returns the current request to the vehicle."""
        age, limit = self.state_age(), self._settings.max_state_age
        if age <= limit:
            return Verdict(CommandMode.APPLY)
        if age <= limit + self._settings.hold_time:
            reason = f"the state is {age:.2f} s old; the input is held"
            return Verdict(CommandMode.HOLD, reason)
        reason = "no state yet" if math.isinf(age) else f"no new state for {age:.2f} s"
        return Verdict(CommandMode.FALLBACK, reason)

    def _echo(self, message: Any) -> tuple[int, int] | None:
        """The echo: the time a command of ours was sent, and its age at the message."""
        if message.command_session != self._bus.session:
            return None
        return message.command_utime, message.command_age

    def _take_over(self, context: Context, state: State) -> EventStatus:
        self._bus.poll()
        if not self.has_news(context):
            return EventStatus.DidNothing()
        last, newest = self.stamp(context), self.inbox.newest
        integral = np.array(newest.input_integral)
        applied = np.zeros_like(integral)
        if newest.time > last.time:
            before = context.get_discrete_state(self._integral).CopyToVector()
            applied = (integral - before) / (newest.time - last.time)
        is_under_way = newest.mode in (VehicleMode.FOLLOWING, VehicleMode.FALLBACK)
        moves = is_under_way or (self.is_followed and newest.mode != VehicleMode.ENDED)
        which = newest.session, newest.sequence, newest.utime, newest.time, moves
        values = newest.state, applied, which, self._delays(), integral
        for index, value in enumerate(values):
            state.get_mutable_discrete_state().set_value(index, value)
        return EventStatus.Succeeded()

    def _delays(self) -> Array:
        """The delays [s]; zeros while the vehicle does not follow our commands."""
        state = self.inbox.newest
        if state.mode != VehicleMode.FOLLOWING or not self.is_followed:
            return np.zeros(2)
        ours = self.inbox.utime
        state_delay = self.inbox.received_at - ours(state.utime_measured)
        command_delay = ours(state.utime - state.command_age) - state.command_utime
        return 1e-6 * np.array([state_delay, command_delay])


# Obstacles -------------------------------------------------------------------------

_TOLERANCE = 0.01  # [m]


class ObstacleInbox(Inbox):
    """The inbox of a vehicle's obstacles, with the resulting request to it.

    Args:
        bus: The bus of the messages.
        vehicle: The states of that vehicle; messages of another one are refused.
        settings: The greatest age of a message.
        take: Takes an accepted message; returns its fault, empty for none.
        are_needed: Whether the vehicle falls back while none come.
    """

    def __init__(
        self,
        bus: Bus,
        vehicle: Inbox,
        settings: Hardware,
        take: Callable[[Any], str],
        *,
        are_needed: bool,
    ) -> None:
        self._bus, self._vehicle, self._are_needed = bus, vehicle, are_needed
        self._max_obstacle_age, self._trouble = settings.max_obstacle_age, ""

        def note_trouble(message: Any, now: int) -> None:
            self._trouble = take(message)

        def refusal(message: Any) -> Reason | None:
            is_first = vehicle.newest is None or vehicle.has_same_sender(message)
            return None if is_first else Reason.SESSION

        super().__init__(
            bus,
            obstacles_format(),
            settings.max_obstacle_age,
            note_trouble,
            silence=0.0,  # The states alone decide which sender is followed.
            max_clock_offset=settings.max_clock_offset,
            refusal=refusal,
        )

    def verdict(self) -> Verdict:
        """Returns the current request to the vehicle."""
        now, trouble = self._bus.clock.utime(), self._trouble
        age = 1e-6 * (now - self.received_at)
        if not self._vehicle.has_same_sender(self.newest):
            trouble = "no obstacles have been perceived yet" * self._are_needed
        elif self._are_needed and age > self._max_obstacle_age:
            trouble = f"no obstacles have been perceived for {age:.2f} s"
        if not trouble:
            return Verdict(CommandMode.APPLY)
        words = filter(None, (trouble, self.complaint(now)))
        return Verdict(CommandMode.FALLBACK, "; ".join(words))


def difference_from(scenario: Scenario, message: Any) -> str:
    """Returns how a vehicle's obstacles differ from a scenario's; empty for equal."""
    spheres, dimensions = scenario.spheres, len(scenario.target)
    sizes = message.num_obstacles, message.num_coordinates
    if sizes != (len(spheres), len(spheres) * dimensions):
        return f"the vehicle does not know of {len(spheres)} obstacles"
    there = np.reshape(message.position, (-1, dimensions))
    for number, (sphere, center) in enumerate(zip(spheres, there, strict=True), 1):
        away = np.linalg.norm(center - sphere.center_at(message.time))
        larger = message.radius[number - 1] - sphere.safety_distance
        if away + abs(larger) > _TOLERANCE:
            return (
                f"the vehicle's obstacle {number} is {away:.3f} m away from the"
                f" scenario's and {larger:+.3f} m larger"
            )
    return ""


class ObstacleReceiver(LeafSystem):
    """The obstacles that a vehicle perceives, for the filter.

    Its port ``obstacles`` is the filter's. Their number may change. Between two
    messages each keeps its velocity. If there are too many of them, none for
    `Hardware.max_obstacle_age`, or malformed ones, the port keeps its last value, and
    the verdict requests the vehicle's fallback.

    Args:
        bus: The bus of the obstacles.
        spheres: The format of the port, with its capacity.
        vehicle: The states of the vehicle that perceives them.
        settings: Their greatest age.

    Attributes:
        inbox: The inbox of the obstacles; its verdict is a `Watchdog`.
    """

    def __init__(
        self,
        bus: Bus,
        spheres: PerceivedSpheres,
        vehicle: Inbox,
        settings: Hardware | None = None,
    ) -> None:
        super().__init__()
        self._bus, self._spheres, settings = bus, spheres, settings or Hardware()
        self.inbox = ObstacleInbox(bus, vehicle, settings, self._take, are_needed=True)
        self._packed = np.zeros(1 + spheres.size)
        # The vehicle's time of the message, then the slots.
        self.DeclareDiscreteState(self._packed)
        self.DeclarePerStepUnrestrictedUpdateEvent(self._take_over)
        self.DeclareForcedUnrestrictedUpdateEvent(self._take_over)
        self.DeclareVectorOutputPort("obstacles", spheres.size, self._calc)

    def _take(self, message: Any) -> str:
        """Takes perceived obstacles, or returns why they cannot be used."""
        k, seen = self._spheres.dimensions, np.array(message.valid, dtype=bool)
        if message.num_coordinates != k * message.num_obstacles:
            have = f"have {message.num_coordinates} coordinates; it must be {k} each"
            return f"the {message.num_obstacles} obstacles that are perceived {have}"
        if seen.sum() > self._spheres.capacity:
            room = f"there is room for {self._spheres.capacity}"
            words = f"{seen.sum()} obstacles are perceived, and {room}"
            return f"{words} (hardware.most_obstacles)"
        radii = np.array(message.radius)[seen]
        if np.any(radii < 0.0):
            return "an obstacle that is perceived has a negative radius"
        vectors = (message.position, message.velocity)
        centers, velocities = (np.reshape(each, (-1, k))[seen] for each in vectors)
        slots = self._spheres.pack(centers, velocities, radii)
        self._packed = np.append(message.time, slots)
        return ""

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
