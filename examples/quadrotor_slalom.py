"""Drake's own quadrotor flies a slalom in the wind; nothing derived by hand.

A quadrotor's position feels the total thrust in its second derivative, the moments in
its fourth: a filter on the rotors could only push along the thrust, and not at all
abeam of an obstacle. Two integrators in front of the thrust make the relative degree 4
for both, so the quadrotor tilts to avoid.

The wind reaches the position in the second derivative already, before any input. The
plain method refuses that; `robust_to` takes the worst of the wind off at every level of
the barriers and leaves only the last to the observer. What it costs is distance. The
nominal controller is Drake's LQR and knows nothing of wind or spheres.

    python examples/quadrotor_slalom.py
"""

import argparse

import numpy as np
from pictures import draw
from pydrake.autodiffutils import AutoDiffXd
from pydrake.examples import QuadrotorPlant
from pydrake.symbolic import Expression
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import LinearQuadraticRegulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem, LeafSystem_
from pydrake.systems.primitives import (
    Demultiplexer,
    LinearSystem,
    LogVectorOutput,
    Multiplexer,
)
from pydrake.systems.scalar_conversion import TemplateSystem

from vcbf_drake import (
    AddSafetyFilter,
    DisturbanceSource,
    FilterSettings,
    InputSet,
    SphereObstacle,
)
from vcbf_drake.barriers import StateLimit
from vcbf_drake.disturbances import DisturbanceEstimate, Sinusoid
from vcbf_drake.safety import FilterStatus
from vcbf_drake.simulation.run import step_cpu_time

GOAL, SPEED, PERIOD = 8.0, 0.8, 0.01  # Along x [m], [m/s]; control period [s].
# The margin is what the quadrotor itself needs [m]. Squares have short derivatives.
SPHERES = [
    SphereObstacle([x, y, 1.0], radius=0.5, margin=0.25, form="squared")
    for x, y in ((2.0, 0.3), (4.0, -0.3), (6.0, 0.3))
]
FOUR_RATES = np.poly([-4.0, -4.5, -5.0, -5.5])[1:]  # K of these decay rates [1/s].
WEIGHT = QuadrotorPlant().m() * QuadrotorPlant().g()  # [N]
# The second derivative of the thrust [N/s^2], moments [N m]: so small that with half
# the weight as thrust no rotor needs to pull.
LIMITS = np.array([400.0, 0.12, 0.12, 0.02])


WIND = [  # Gusts along x, y and z, as accelerations [m/s^2]; at most 0.86 together.
    Sinusoid([0.5, 0.0, 0.0], 0.9, 0.0),
    Sinusoid([0.0, 0.5, 0.0], 1.3, 1.0),
    Sinusoid([0.0, 0.0, 0.5], 0.7, 2.0),
]


@TemplateSystem.define("WindyQuadrotor_")
def WindyQuadrotor_(T):
    """Makes the class WindyQuadrotor_[T] for the scalar type T."""

    class Impl(LeafSystem_[T]):
        """QuadrotorPlant with a port for the wind."""

        def _construct(self, converter=None):
            LeafSystem_[T].__init__(self, converter=converter)
            self._calm = QuadrotorPlant()
            if T is AutoDiffXd:
                self._calm = self._calm.ToAutoDiffXd()
            elif T is Expression:
                self._calm = self._calm.ToSymbolic()
            self._context = self._calm.CreateDefaultContext()
            self._force = self.DeclareVectorInputPort("rotor_force", 4)
            self._wind = self.DeclareVectorInputPort("wind", 3)
            self.DeclareStateOutputPort("state", self.DeclareContinuousState(6, 6, 0))

        def _construct_copy(self, other, converter=None):
            Impl._construct(self, converter=converter)

        def DoCalcTimeDerivatives(self, context, derivatives):
            state = context.get_continuous_state_vector().CopyToVector()
            self._context.SetContinuousState(state)
            force = self._force.Eval(context)
            self._calm.get_input_port().FixValue(self._context, force)
            rate = self._calm.EvalTimeDerivatives(self._context).CopyToVector()
            rate[6:9] += self._wind.Eval(context)
            derivatives.get_mutable_vector().SetFromVector(rate)

    return Impl


WindyQuadrotor = WindyQuadrotor_[None]


def quadrotor():
    """Returns the quadrotor driven by the thrust's second derivative and moments."""
    a, k = QuadrotorPlant().length(), 0.0245  # Arm [m], moment per thrust [m].
    wrench = [[1, 1, 1, 1], [0, a, 0, -a], [-a, 0, a, 0], [k, -k, k, -k]]
    mix = np.linalg.inv(wrench)
    thrust = LinearSystem(  # From the inputs to rotor forces, thrust' and thrust.
        A=[[0.0, 0.0], [1.0, 0.0]],
        B=[[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]],
        C=np.vstack([np.outer(mix[:, 0], [0.0, 1.0]), np.eye(2)]),
        D=np.vstack([mix * [0.0, 1.0, 1.0, 1.0], np.zeros((2, 4))]),
    )
    builder = DiagramBuilder()
    plant = builder.AddSystem(WindyQuadrotor())
    builder.AddSystem(thrust)
    split = builder.AddSystem(Demultiplexer([4, 2]))
    state = builder.AddSystem(Multiplexer([12, 2]))
    builder.Connect(thrust.get_output_port(), split.get_input_port())
    builder.Connect(split.get_output_port(0), plant.GetInputPort("rotor_force"))
    builder.Connect(plant.get_output_port(), state.get_input_port(0))
    builder.Connect(split.get_output_port(1), state.get_input_port(1))
    builder.ExportInput(thrust.get_input_port(), "input")
    builder.ExportInput(plant.GetInputPort("wind"), "disturbance")
    builder.ExportOutput(state.get_output_port(), "state")
    builder.ExportOutput(split.get_output_port(0), "rotor_force")
    return builder.Build()


def hover(t):
    """Returns the state of a point that moves to the goal, at time t [s]."""
    state = np.zeros(14)
    state[[0, 2, 13]] = min(SPEED * t, GOAL), 1.0, WEIGHT
    state[6] = SPEED if SPEED * t < GOAL else 0.0
    return state


class TrackingLqr(LeafSystem):
    """Drake's LQR about hover, after a point that moves to the goal."""

    def __init__(self, plant):
        super().__init__()
        context = plant.CreateDefaultContext()
        context.SetContinuousState(hover(np.inf))
        for i in range(2):
            plant.get_input_port(i).FixValue(context, np.zeros((4, 3)[i]))
        Q = np.diag([4, 4, 4, 1, 1, 1, 2, 2, 2, 0.1, 0.1, 0.1, 1e-3, 0.1])
        lqr = LinearQuadraticRegulator(plant, context, Q, np.diag(LIMITS**-2.0))
        self._gain = lqr.D()
        self._state = self.DeclareVectorInputPort("state", 14)
        self.DeclareVectorOutputPort("reference", 4, self._calc_reference)

    def _calc_reference(self, context, output):
        error = self._state.Eval(context) - hover(context.get_time())
        error[:2] = np.clip(error[:2], -1.0, 1.0)
        output.SetFromVector(self._gain @ error)


def main() -> None:
    """Flies the slalom and prints how near it came and what a tick costs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="4 s only, for a check")
    duration = 4.0 if parser.parse_args().short else 13.0

    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", quadrotor())
    controller = builder.AddNamedSystem("controller", TrackingLqr(plant))
    wind = builder.AddNamedSystem("wind", DisturbanceSource(WIND, duration))
    builder.Connect(wind.get_output_port(), plant.GetInputPort("disturbance"))
    builder.Connect(plant.GetOutputPort("state"), controller.get_input_port())
    thrust = StateLimit(13, lower=0.5 * WEIGHT, upper=1.8 * WEIGHT)
    safety = AddSafetyFilter(
        builder,
        plant=plant,
        reference=controller.get_output_port(),
        barriers=[
            *(
                s.barrier(FOUR_RATES, [0, 1, 2]).robust_to(wind.bounds.delta1)
                for s in SPHERES
            ),
            *thrust.barriers([40.0, 400.0]),
        ],
        input_set=InputSet.box(-LIMITS, LIMITS),
        bounds=wind.bounds,
        settings=FilterSettings(period=PERIOD),
    )
    state, rotors = map(plant.GetOutputPort, ("state", "rotor_force"))
    path, forces = (LogVectorOutput(port, builder) for port in (state, rotors))
    ports = {"state": state, "reference": controller.get_output_port()}
    ports["status"] = safety.filter.GetOutputPort("status")
    ports["estimate"] = safety.observer.GetOutputPort("estimate")
    ticks = {n: LogVectorOutput(port, builder, PERIOD) for n, port in ports.items()}
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    plant.GetMyMutableContextFromRoot(context).SetContinuousState(hover(0.0))
    simulator.AdvanceTo(duration)

    x, time = path.FindLog(context).data().T, path.FindLog(context).sample_times()
    gaps = [s.clearance(x[:, :3], time) - s.margin for s in SPHERES]
    h = np.column_stack(gaps)
    log = {name: each.FindLog(context).data().T for name, each in ticks.items()}
    log["time"] = ticks["state"].FindLog(context).sample_times()
    log |= DisturbanceEstimate.unpack(log["estimate"]).log_arrays()
    cpu = step_cpu_time(safety.filter, log)
    solid, dotted = {"color": "#9aa5b4"}, {"fill": False, "ls": ":"}
    discs = [(s.center, s.radius, solid) for s in SPHERES]
    discs += [(s.center, s.safety_distance, dotted) for s in SPHERES]
    draw("quadrotor_slalom", [x[:, :2]], discs, time, h)
    left = np.linalg.norm(x[-1, :3] - hover(np.inf)[:3])
    print(f"wind: at most {wind.bounds.delta1:.2f} m/s^2")
    print(f"min h: {h.min():.4f} m, between the ticks too; to the goal: {left:.2f} m")
    print(f"infeasible ticks: {np.sum(log['status'] >= FilterStatus.INFEASIBLE)}")
    print(f"least rotor force: {forces.FindLog(context).data().min():.2f} N")
    print(f"tick CPU time: median {cpu['median']:.2f} ms, p99 {cpu['p99']:.2f} ms")


if __name__ == "__main__":
    main()
