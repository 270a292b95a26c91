"""A plant of your own: a boat with quadratic drag and its own port names.

The filter needs only a LeafSystem template, so that Drake can evaluate it with symbolic
scalars, that is affine in the input and in the disturbance.

    python examples/own_plant.py
"""

import argparse

import numpy as np
from pictures import draw
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import PidController
from pydrake.systems.framework import DiagramBuilder, LeafSystem_
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput
from pydrake.systems.scalar_conversion import TemplateSystem

from vcbf_drake import (
    AddSafetyFilter,
    ControlAffineModel,
    DisturbanceSource,
    InputSet,
    SphereObstacle,
)
from vcbf_drake.disturbances import Sinusoid, SmoothStep
from vcbf_drake.safety import FilterStatus

MASS, DRAG = 12.0, 4.0  # [kg], [kg/m]
GOAL = [9.0, 1.0]  # [m]
BUOYS = [
    SphereObstacle([3.0, 0.2], 0.8, margin=0.2),
    SphereObstacle([6.0, 1.4], 0.8, margin=0.2),
    SphereObstacle([5.0, -2.4], 0.6, velocity=[0.1, 0.12], margin=0.2),
]


@TemplateSystem.define("Boat_")
def Boat_(T):
    """Makes the class Boat_[T] for the scalar type T."""

    class Impl(LeafSystem_[T]):
        """A boat that two pairs of thrusters push along x and y."""

        state_names = ("x", "y", "vx", "vy")

        def _construct(self, converter=None):
            LeafSystem_[T].__init__(self, converter=converter)
            self._thrust = self.DeclareVectorInputPort("thrust", 2)  # [N]
            self._gust = self.DeclareVectorInputPort("gust", 2)  # [m/s^2]
            self.DeclareStateOutputPort("motion", self.DeclareContinuousState(2, 2, 0))

        def _construct_copy(self, other, converter=None):
            Impl._construct(self, converter=converter)

        def DoCalcTimeDerivatives(self, context, derivatives):
            _, _, vx, vy = context.get_continuous_state_vector().CopyToVector()
            fx, fy = self._thrust.Eval(context)
            dx, dy = self._gust.Eval(context)
            # Smooth at rest too: a speed of 0 has no derivative.
            drag = DRAG * (vx * vx + vy * vy + 1e-4) ** 0.5
            ax, ay = (fx - drag * vx) / MASS + dx, (fy - drag * vy) / MASS + dy
            derivatives.get_mutable_vector().SetFromVector(np.array([vx, vy, ax, ay]))

    return Impl


Boat = Boat_[None]


def main() -> None:
    """Steers the boat between buoys, one of them adrift, in gusts and a current."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="8 s only, for a check")
    duration = 8.0 if parser.parse_args().short else 24.0

    builder = DiagramBuilder()
    boat = builder.AddNamedSystem("boat", Boat())
    pilot = builder.AddNamedSystem("pilot", PidController([4, 4], [0, 0], [14, 14]))
    goal = builder.AddSystem(ConstantVectorSource([*GOAL, 0.0, 0.0]))
    gusts = [Sinusoid([0.03, 0.06], 0.9, 0.0), SmoothStep([-0.05, 0.05], 4.0, 3.0)]
    wind = builder.AddSystem(DisturbanceSource(gusts, duration))
    builder.Connect(boat.get_output_port(), pilot.get_input_port_estimated_state())
    builder.Connect(goal.get_output_port(), pilot.get_input_port_desired_state())
    builder.Connect(wind.get_output_port(), boat.GetInputPort("gust"))
    safety = AddSafetyFilter(
        builder,
        plant=boat.GetInputPort("thrust"),
        model=ControlAffineModel.from_system(boat, "thrust", "gust"),
        reference=pilot.get_output_port_control(),
        barriers=[buoy.barrier(gains=[3.0, 2.0]) for buoy in BUOYS],
        input_set=InputSet.box([-4.0, -4.0], [4.0, 4.0]),
        bounds=wind.bounds,
    )
    motion = LogVectorOutput(boat.get_output_port(), builder)
    status = LogVectorOutput(safety.filter.GetOutputPort("status"), builder, 0.02)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(duration)

    log = motion.FindLog(simulator.get_context())
    x, time = log.data().T, log.sample_times()
    h = safety.filter.barrier_set.values_along(x, time)
    codes = status.FindLog(simulator.get_context()).data()
    discs = [
        (buoy.center_at(t), buoy.radius, {"color": "#9aa5b4", "alpha": 0.25})
        for buoy in BUOYS
        for t in np.linspace(0.0, duration, 4)
    ]
    draw("own_plant", [x[:, :2]], discs, time, h)
    print(f"min h: {h.min():.3f} m, between the ticks too")
    print(f"to the goal: {np.linalg.norm(x[-1, :2] - GOAL):.2f} m")
    print(f"infeasible ticks: {np.sum(codes >= FilterStatus.INFEASIBLE)}")


if __name__ == "__main__":
    main()
