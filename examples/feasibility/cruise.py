"""Adaptive cruise control as a scenario: relative degree 1, one input, a weak brake.

Constants: Ames, Xu, Grizzle and Tabuada, IEEE Transactions on Automatic Control, 2017.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import LeafSystem_, System
from pydrake.systems.scalar_conversion import TemplateSystem

from vcbf_drake import Barrier, InputLimits, Scenario, StateFeedback, Vehicle

MASS, GRAVITY, F0, F1, F2 = 1650.0, 9.81, 0.1, 5.0, 0.25  # [kg], [m/s^2], [N], ...
AHEAD, DESIRED, HEADWAY = 14.0, 24.0, 1.8  # [m/s], [m/s], [s]
MOST = 0.3 * MASS * GRAVITY  # [N]


@TemplateSystem.define("Follower_")
def Follower_(T):  # noqa: D103
    class Impl(LeafSystem_[T]):
        state_names, state_units = ("speed", "distance"), ("m/s", "m")
        input_names, input_units = ("force",), ("N",)

        def _construct(self, converter=None):
            LeafSystem_[T].__init__(self, converter=converter)
            self._force = self.DeclareVectorInputPort("input", 1)
            self.DeclareStateOutputPort("state", self.DeclareContinuousState(2))

        def _construct_copy(self, other, converter=None):
            Impl._construct(self, converter=converter)

        def DoCalcTimeDerivatives(self, context, derivatives):
            speed, _ = context.get_continuous_state_vector().CopyToVector()
            (force,) = self._force.Eval(context)
            rates = [(force - resistance(speed)) / MASS, AHEAD - speed]
            derivatives.get_mutable_vector().SetFromVector(np.array(rates))

    return Impl


def resistance(speed):
    """Returns what rolling and air take [N]."""
    return F0 + F1 * speed + F2 * speed * speed


@dataclass
class Follower(Vehicle):
    """A car behind a slower one.

    Attributes:
        gain: K of the headway's barrier [1/s].
    """

    gain: float = 5.0
    position = (1,)

    def make_plant(self) -> System:
        """Returns the car: its speed, and its distance from the car ahead."""
        return Follower_[None]()

    def make_controller(self, target) -> System:
        """Returns a controller that holds the desired speed whatever is ahead."""

        def law(x):
            return [resistance(x[0]) + 0.8 * MASS * (DESIRED - x[0])]

        return StateFeedback(law, 2, 1)

    def barriers(self) -> list[Barrier]:
        """Returns the headway, h = D - 1.8 v [m]."""
        return [
            Barrier(lambda x, t, p: x[1] - HEADWAY * x[0], [self.gain], name="headway")
        ]


def scenario() -> Scenario:
    """Returns the scenario of the published start; h = 0 would be its target."""
    return Scenario(
        name="cruise",
        vehicle=Follower(),
        input_set=InputLimits([-MOST], [MOST]),
        initial_state=[20.0, 100.0],
        target=[HEADWAY * AHEAD],
        infeasible="stop",
        duration=40.0,
    )


def can_stop(speed: float, distance: float) -> bool:
    """Returns whether full braking keeps the headway from a start."""
    h = distance - HEADWAY * speed
    while speed > AHEAD and h >= 0.0:
        step = 0.01
        distance += step * (AHEAD - speed)
        speed -= step * (MOST + resistance(speed)) / MASS
        h = distance - HEADWAY * speed
    return h >= 0.0
