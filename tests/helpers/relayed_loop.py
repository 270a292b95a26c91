"""A vehicle and its controller with somebody between them who changes what is said."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pydrake.lcm import DrakeLcm

from vcbf_drake.hil import Bus, PlantProcess, SimulatedClock, controller_of
from vcbf_drake.hil.messages import vcbf_command, vcbf_obstacles, vcbf_state

CHANNELS = {"VCBF_STATE": vcbf_state, "VCBF_OBSTACLES": vcbf_obstacles}


class RelayedLoop:
    """Both halves in lockstep over two buses; `change` sees what the vehicle says.

    Args:
        scenario: What is run.
        change: Takes a vehicle's message and returns what goes on, None for nothing.
        change_command: Takes a command and returns what goes on.
        known: The controller's scenario, if it is another one.

    Attributes:
        plant: The vehicle.
        controller: The controller.
        clock: The clock of both.
    """

    def __init__(
        self,
        scenario: Any,
        change: Callable[[Any], Any],
        change_command: Callable[[Any], Any] = lambda message: message,
        known: Any = None,
    ) -> None:
        self.clock = SimulatedClock()
        self._theirs, self._ours = DrakeLcm("memq://"), DrakeLcm("memq://")
        self.controller = controller_of(known or scenario, Bus(self._ours, self.clock))
        for name, kind in CHANNELS.items():
            self._theirs.Subscribe(
                name,
                lambda data, name=name, kind=kind: self._forward(
                    name, change(kind.decode(data))
                ),
            )
        self._ours.Subscribe(
            "VCBF_COMMAND",
            lambda data: self._theirs.Publish(
                "VCBF_COMMAND", change_command(vcbf_command.decode(data)).encode()
            ),
        )
        self._scenario, self._period = scenario, scenario.period
        self._start_plant()

    def _start_plant(self) -> None:
        self.plant = PlantProcess(self._scenario, Bus(self._theirs, self.clock))
        self._epoch, self._tick = self.clock.now, 0
        self._exchange()

    def restart_plant(self, after: float = 1.0) -> None:
        """Starts another vehicle, so long [s] after the first one fell silent."""
        self.clock.now += round(1e6 * after)
        self._start_plant()

    def advance_to(self, time: float) -> None:
        """Runs both to a time [s], or to a collision."""
        while not self.plant.collided and (self._tick + 1) * self._period < time + 1e-9:
            self._tick += 1
            self.clock.now = self._epoch + round(1e6 * self._tick * self._period)
            self.plant.advance_to(self._tick * self._period)
            self._exchange()

    def _forward(self, name: str, message: Any) -> None:
        if message is not None:
            self._ours.Publish(name, message.encode())

    def _exchange(self) -> None:
        self._theirs.HandleSubscriptions(0)
        self.controller.step()
        self._ours.HandleSubscriptions(0)
        self.plant.bus.poll()
