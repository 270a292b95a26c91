"""Both halves in one process, on a simulated clock: the same run bit for bit."""

from __future__ import annotations

from pydrake.lcm import DrakeLcm

from vcbf_drake.hil.bus import Bus, Tap
from vcbf_drake.hil.clock import SimulatedClock
from vcbf_drake.hil.controller_process import ControllerProcess
from vcbf_drake.hil.faults import LinkFaults
from vcbf_drake.hil.plant_process import PlantProcess
from vcbf_drake.simulation.scenario import Scenario


class InProcess:
    """Drives a vehicle and its controller in lockstep over ``memq://``.

    The clock stands still while either side computes, so without faults a command
    reaches the vehicle at the instant its state was measured: the run is that of
    `simulate`. With faults, messages arrive on a grid of time.

    Args:
        scenario: A validated scenario.
        vehicle_faults: Injected into the commands.
        controller_faults: Injected into the states.
        grid: How many times in a control period messages are handled.
        tap: Told of everything that the controller's side sends and receives.

    Attributes:
        clock: What both sides take for the time.
        lcm: The bus both are on.
        plant: The vehicle's side.
        controller: The controller's side; None while it is dead.
    """

    def __init__(
        self,
        scenario: Scenario,
        vehicle_faults: LinkFaults | None = None,
        controller_faults: LinkFaults | None = None,
        grid: int = 1,
        tap: Tap | None = None,
    ) -> None:
        self.clock = SimulatedClock()
        self.lcm = DrakeLcm("memq://")
        self.controller: ControllerProcess | None = None
        self._scenario, self._faults = scenario, controller_faults
        self._grid, self._instant, self._tap = grid, 0, tap
        self._epoch = self.clock.now
        self.start_controller()
        self.plant = PlantProcess(scenario, Bus(self.lcm, self.clock, vehicle_faults))
        self._exchange()

    def start_controller(self) -> None:
        """Starts a controller, or another one, which knows nothing of the first."""
        bus = Bus(self.lcm, self.clock, self._faults)
        if self._tap is not None:
            bus.taps.append(self._tap)
        self.controller = ControllerProcess(self._scenario, bus)

    def kill_controller(self) -> None:
        """Ends the controller without a farewell."""
        self.controller = None

    def advance_to(self, time: float) -> None:
        """Runs both sides up to a time [s], or to a collision."""
        while not self.plant.collided:
            step, part = divmod(self._instant + 1, self._grid)
            instant = (step + part / self._grid) * self._scenario.period
            if instant > time + 1e-9:
                return
            self._instant += 1
            self.clock.now = self._epoch + round(1e6 * instant)
            self.plant.advance_to(instant)
            self._exchange()

    def _exchange(self) -> None:
        if self.controller is not None:
            self.controller.step()
        self.plant.bus.poll()
