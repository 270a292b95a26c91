"""A robot of your own, from its dynamics to a replay: a puck on an air table.

vcbf-drake run examples/own_robot.py                (docs/guide/own_robot.md)
"""

from dataclasses import dataclass

from pydrake.systems.framework import LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem

from vcbf_drake import InputLimits, Scenario, SphereObstacle, StateFeedback, Vehicle
from vcbf_drake.disturbances import Sinusoid


@TemplateSystem.define("Puck_")
def Puck_(T):  # noqa: D103
    class Impl(LeafSystem_[T]):
        state_names, state_units = ("x", "y", "vx", "vy"), ("m", "m", "m/s", "m/s")
        input_names, input_units = ("force_x", "force_y"), ("N", "N")

        def _construct(self, mass, converter=None):
            LeafSystem_[T].__init__(self, converter=converter)
            self.mass = mass
            self.force = self.DeclareVectorInputPort("input", 2)
            self.draught = self.DeclareVectorInputPort("disturbance", 2)
            self.DeclareStateOutputPort("state", self.DeclareContinuousState(2, 2, 0))

        def _construct_copy(self, other, converter=None):
            Impl._construct(self, other.mass, converter)

        def DoCalcTimeDerivatives(self, context, derivatives):
            _, _, vx, vy = context.get_continuous_state_vector().CopyToVector()
            force, draught = self.force.Eval(context), self.draught.Eval(context)
            rate = [vx, vy, *(force / self.mass + draught)]
            derivatives.get_mutable_vector().SetFromVector(rate)

    return Impl


@dataclass
class Puck(Vehicle):  # noqa: D101
    mass: float = 0.5
    position = (0, 1)

    def make_plant(self):  # noqa: D102
        return Puck_[None](self.mass)

    def make_controller(self, target):  # noqa: D102
        return StateFeedback(lambda x: target - x[:2] - x[2:], 4, 2)


def scenario():  # noqa: D103
    return Scenario(
        vehicle=Puck(),
        input_set=InputLimits([-1.0, -1.0], [1.0, 1.0]),
        disturbance=[Sinusoid([0.1, 0.2], frequency=2.0)],
        obstacles=[SphereObstacle([1.0, 0.1], 0.2), SphereObstacle([2.0, -0.3], 0.3)],
        initial_state=[0.0, 0.0, 0.0, 0.0],
        target=[3.0, 0.0],
    )
