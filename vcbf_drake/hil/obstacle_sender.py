"""ObstacleSender: publishes where a simulated vehicle's obstacles are."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import Context, LeafSystem

from vcbf_drake.hil.bus import Bus
from vcbf_drake.hil.decoding import obstacles_format
from vcbf_drake.hil.messages import vcbf_obstacles
from vcbf_drake.hil.outbox import Outbox
from vcbf_drake.simulation.scenario import Scenario

_PERIOD = 0.5  # [s]


class ObstacleSender(LeafSystem):
    """Publishes the scenario's obstacles twice a second and at forced events.

    .. pydrake_system::

        name: ObstacleSender

    Args:
        bus: Where to.
        scenario: Has the obstacles.
    """

    def __init__(self, bus: Bus, scenario: Scenario) -> None:
        super().__init__()
        self._obstacles, dimensions = scenario.obstacles, len(scenario.target)
        self._outbox = Outbox(
            bus, obstacles_format(len(self._obstacles), dimensions).channel
        )
        self.DeclarePeriodicPublishEvent(_PERIOD, 0.0, self._send)
        self.DeclareForcedPublishEvent(self._send)

    def _send(self, context: Context) -> None:
        message = vcbf_obstacles()
        message.time = context.get_time()
        for obstacle in self._obstacles:
            center = np.array(obstacle.center)
            velocity = np.array(obstacle.velocity or np.zeros_like(center))
            message.radius.append(obstacle.radius + obstacle.margin)
            message.valid.append(True)
            message.position.extend(center + message.time * velocity)
            message.velocity.extend(velocity)
        message.num_obstacles = len(message.radius)
        message.num_coordinates = len(message.position)
        self._outbox.send(message)
