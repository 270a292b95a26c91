"""Drake's quadrotor flies a slalom in wind, without any derivation by hand.

The total thrust enters the second derivative of a quadrotor's position, the moments
enter the fourth: a filter on the rotors could only push along the thrust, and not at
all abeam of an obstacle. Two integrators in front of the thrust make the relative
degree 4 for both, so the quadrotor tilts to avoid. The wind enters the second
derivative, before any input: ``robust`` makes every level of the barriers robust
against it. The controller, Drake's LQR, takes no account of wind or spheres.

    vcbf-drake run examples/quadrotor_slalom.py
"""

from dataclasses import dataclass

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.examples import QuadrotorPlant
from pydrake.geometry import Box, Cylinder
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.symbolic import Expression
from pydrake.systems.controllers import LinearQuadraticRegulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem_
from pydrake.systems.primitives import Demultiplexer, LinearSystem, Multiplexer
from pydrake.systems.scalar_conversion import TemplateSystem

from vcbf_drake import (
    InputLimits,
    Scenario,
    SphereObstacle,
    StateFeedback,
    Vehicle,
    VolumeBarrier,
)
from vcbf_drake.barriers import StateLimit
from vcbf_drake.disturbances import Sinusoid
from vcbf_drake.plants import Part
from vcbf_drake.simulation import BarrierGains

ARM, INERTIA, MOMENT = 0.175, np.diag([0.0023, 0.0023, 0.0040]), 0.0245
# The second derivative of the thrust [N/s^2], moments [N m]: so small that with half
# the weight as thrust no rotor needs to pull.
LIMITS = [400.0, 0.12, 0.12, 0.02]


@TemplateSystem.define("WindyQuadrotor_")
def WindyQuadrotor_(T):
    """Makes the class WindyQuadrotor_[T], QuadrotorPlant with a port for the wind."""

    class Impl(LeafSystem_[T]):
        def _construct(self, mass, converter=None):
            LeafSystem_[T].__init__(self, converter=converter)
            calm, self.mass = QuadrotorPlant(mass, ARM, INERTIA, 1.0, MOMENT), mass
            converted = {AutoDiffXd: calm.ToAutoDiffXd, Expression: calm.ToSymbolic}
            self.calm = converted.get(T, lambda: calm)()
            self.context = self.calm.CreateDefaultContext()
            self.force = self.DeclareVectorInputPort("rotor_force", 4)
            self.wind = self.DeclareVectorInputPort("wind", 3)
            self.DeclareStateOutputPort("state", self.DeclareContinuousState(6, 6, 0))

        def _construct_copy(self, other, converter=None):
            Impl._construct(self, other.mass, converter)

        def DoCalcTimeDerivatives(self, context, derivatives):
            state = context.get_continuous_state_vector().CopyToVector()
            self.context.SetContinuousState(state)
            self.calm.get_input_port().FixValue(self.context, self.force.Eval(context))
            rate = self.calm.EvalTimeDerivatives(self.context).CopyToVector()
            rate[6:9] += self.wind.Eval(context)
            derivatives.get_mutable_vector().SetFromVector(rate)

    return Impl


@dataclass
class Quadrotor(Vehicle):
    """A quadrotor driven by the second derivative of its thrust, and by moments."""

    mass: float = 0.5
    position = (0, 1, 2)

    @property
    def weight(self):
        """The weight that the rotors bear at hover [N]."""
        return 9.81 * self.mass

    def make_plant(self):
        """Returns two integrators, the rotors and the quadrotor."""
        k = MOMENT
        mix = np.linalg.inv([[1, 1, 1, 1], [0, ARM, 0, -ARM], [-ARM, 0, ARM, 0],
                             [k, -k, k, -k]])  # fmt: skip
        builder = DiagramBuilder()
        body = builder.AddSystem(WindyQuadrotor_[None](self.mass))
        thrust = builder.AddSystem(
            LinearSystem(  # From the inputs to rotor forces, thrust' and thrust.
                A=[[0.0, 0.0], [1.0, 0.0]],
                B=[[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]],
                C=np.vstack([np.outer(mix[:, 0], [0.0, 1.0]), np.eye(2)]),
                D=np.vstack([mix * [0.0, 1.0, 1.0, 1.0], np.zeros((2, 4))]),
            )
        )
        split = builder.AddSystem(Demultiplexer([4, 2]))
        state = builder.AddSystem(Multiplexer([12, 2]))
        builder.Connect(thrust.get_output_port(), split.get_input_port())
        builder.Connect(split.get_output_port(0), body.GetInputPort("rotor_force"))
        builder.Connect(body.get_output_port(), state.get_input_port(0))
        builder.Connect(split.get_output_port(1), state.get_input_port(1))
        builder.ExportInput(thrust.get_input_port(), "input")
        builder.ExportInput(body.GetInputPort("wind"), "disturbance")
        builder.ExportOutput(state.get_output_port(), "state")
        plant = builder.Build()
        places = ["x", "y", "z", "roll", "pitch", "yaw"]
        rates = [f"{name}_rate" for name in places]
        plant.state_names = [*places, *rates, "thrust_rate", "thrust"]
        plant.state_units = [*3 * ["m"], *3 * ["rad"], *3 * ["m/s"], *3 * ["rad/s"],
                             "N/s", "N"]  # fmt: skip
        plant.input_names = ["thrust_2nd_rate", "roll_moment", "pitch_moment",
                             "yaw_moment"]  # fmt: skip
        plant.input_units = ["N/s^2", *3 * ["N m"]]
        return plant

    def hover(self, place):
        """Returns the state at rest somewhere."""
        return np.array([*place, *np.zeros(10), self.weight])

    def make_controller(self, target):
        """Returns Drake's LQR about hover, in no hurry to a far target."""
        plant, hover = self.make_plant(), self.hover(target)
        context = plant.CreateDefaultContext()
        context.SetContinuousState(hover)
        plant.GetInputPort("input").FixValue(context, np.zeros(4))
        plant.GetInputPort("disturbance").FixValue(context, np.zeros(3))
        Q = np.diag([4, 4, 4, 1, 1, 1, 4, 4, 4, 0.1, 0.1, 0.1, 1e-3, 0.1])
        R = np.diag(np.array(LIMITS) ** -2.0)
        lqr = LinearQuadraticRegulator(plant, context, Q, R).D()

        def law(state):
            error = state - hover
            error[:3] *= min(1.0, 1.4 / max(np.linalg.norm(error[:3]), 1e-9))
            return lqr @ error

        return StateFeedback(law, 14, 4)

    def barriers(self):
        """Returns the limits of the thrust."""
        thrust = StateLimit(13, lower=0.5 * self.weight, upper=1.8 * self.weight)
        return thrust.barriers([40.0, 400.0], "thrust")

    def geometry(self, color):
        """Returns a body and four rotors."""
        disc, h = Cylinder(0.11, 0.015), 0.03
        at = [(ARM, 0, h), (0, ARM, h), (-ARM, 0, h), (0, -ARM, h)]
        rotors = [
            Part(f"rotor_{i}", disc, color, RigidTransform(p)) for i, p in enumerate(at)
        ]
        arms = [Box(2 * ARM, 0.03, 0.03), Box(0.03, 2 * ARM, 0.03)]
        return [*rotors, *(Part(f"arm_{i}", a, "#38424f") for i, a in enumerate(arms))]

    def pose(self, state):
        """Returns where it is, and how it tilts."""
        return RigidTransform(RollPitchYaw(*state[3:6]), state[:3])


def scenario():
    """Returns the slalom: three spheres in the way, gusts of 0.86 m/s^2 at most."""
    robot = Quadrotor()
    return Scenario(
        description="A quadrotor's slalom between three spheres, in the wind.",
        vehicle=robot,
        input_set=InputLimits([-limit for limit in LIMITS], LIMITS),
        disturbance=[
            Sinusoid([0.5, 0.0, 0.0], 0.9, 0.0),
            Sinusoid([0.0, 0.5, 0.0], 1.3, 1.0),
            Sinusoid([0.0, 0.0, 0.5], 0.7, 2.0),
        ],
        # The margin is what the quadrotor itself needs.
        obstacles=[
            SphereObstacle([x, y, 1.0], 0.5, margin=0.25)
            for x, y in ((2.0, 0.3), (4.0, -0.3), (6.0, 0.3))
        ],
        # Squares have short derivatives; four decay rates for four derivatives.
        # The paper's volume barrier: felt where it cuts, so that it flies close by. The
        # default, felt early, keeps four times as far away and arrives 0.3 s later.
        volume=VolumeBarrier(gain=3.0, widening=1.0),
        barrier=BarrierGains(
            form="squared",
            gains=np.poly([-4.0, -4.5, -5.0, -5.5])[1:].tolist(),
            robust=True,
        ),
        initial_state=robot.hover([0.0, 0.0, 1.0]).tolist(),
        target=[8.0, 0.0, 1.0],
        arrival_tolerance=0.5,
        duration=13.0,
        period=0.01,
    )
