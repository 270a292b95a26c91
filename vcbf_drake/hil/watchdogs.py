"""What the controller's side watches: the age of states, the obstacles."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from vcbf_drake.hil.bus import Bus, Clock
from vcbf_drake.hil.decoding import CommandMode, Reason, obstacles_format
from vcbf_drake.hil.mailbox import Inbox
from vcbf_drake.simulation.scenario import Hardware, Scenario


class Verdict(NamedTuple):
    """What to ask of the vehicle, and why; the reason is empty with APPLY."""

    mode: CommandMode
    reason: str


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
        return 1e-6 * (self._clock.utime() - self._states.newest.utime_measured)

    def verdict(self) -> Verdict:
        """Returns what to ask of the vehicle now."""
        age, limit = self.state_age(), self._settings.max_state_age
        if age <= limit:
            return Verdict(CommandMode.APPLY, "")
        if age <= limit + self._settings.hold_time:
            reason = f"the state is {age:.2f} s old; the input is held"
            return Verdict(CommandMode.HOLD, reason)
        return Verdict(CommandMode.FALLBACK, f"no new state for {age:.2f} s")


_TOLERANCE = 0.01  # [m]
_MAX_AGE = 1.0  # [s]


class ObstacleWatch:
    """Compares the obstacles that a vehicle publishes with those of the scenario.

    A vehicle that publishes none is not checked.

    Args:
        bus: Where they come from.
        scenario: What the controller knows.

    Attributes:
        inbox: What arrived.
    """

    def __init__(self, bus: Bus, scenario: Scenario) -> None:
        self._difference = ""
        self._obstacles = scenario.obstacles
        self._shape = len(scenario.obstacles), len(scenario.target)
        self.inbox = Inbox(bus, obstacles_format(*self._shape), _MAX_AGE, self._compare)

    @property
    def difference(self) -> str:
        """In words, what is different; empty while nothing is."""
        if not self.inbox.accepted and self.inbox.rejections[Reason.SIZE]:
            return f"the vehicle does not know of {self._shape[0]} obstacles"
        return self._difference

    def _compare(self, message: Any, now: int) -> None:
        self._difference = ""
        centers = np.reshape(message.position, self._shape)
        for number, (obstacle, center, radius) in enumerate(
            zip(self._obstacles, centers, message.radius, strict=True), start=1
        ):
            velocity = np.array(obstacle.velocity or np.zeros_like(center))
            known = np.array(obstacle.center) + message.time * velocity
            away = float(np.linalg.norm(center - known))
            larger = radius - (obstacle.radius + obstacle.margin)
            if away + abs(larger) > _TOLERANCE:
                self._difference = (
                    f"the vehicle's obstacle {number} is {away:.2f} m away from the"
                    f" scenario's and {larger:+.2f} m larger"
                )
                return
