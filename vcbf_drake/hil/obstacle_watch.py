"""ObstacleWatch: whether vehicle and controller know of the same obstacles."""

from __future__ import annotations

from typing import Any

import numpy as np

from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.decoding import Reason, obstacles_format
from vcbf_drake.hil.inbox import Inbox
from vcbf_drake.simulation.scenario import Scenario

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
