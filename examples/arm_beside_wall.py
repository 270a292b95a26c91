"""A robot arm from a URDF file swings down beside a wall that its path crosses.

A MultibodyPlant, Drake's inverse dynamics controller, and the filter between the two.
The position of the hand and its derivatives come from the plant: the program contains
no forward kinematics, Jacobian or mass matrix.

    python examples/arm_beside_wall.py
"""

import argparse
from pathlib import Path

from matplotlib.patches import Polygon, Rectangle
import numpy as np
from pictures import draw
from pydrake.geometry import Box, Meshcat, MeshcatParams, MeshcatVisualizer
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.symbolic import Evaluate
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import InverseDynamicsController
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from vcbf_drake import AddSafetyFilter, FilterSettings, InputSet, VolumeBarrier
from vcbf_drake.barriers import HalfSpace, StateLimit
from vcbf_drake.disturbances import DisturbanceBounds
from vcbf_drake.model import point_position
from vcbf_drake.safety import FilterStatus

ARM = Path(__file__).parent / "models" / "planar_arm.urdf"
WALL, HAND, PERIOD = 0.85, 0.05, 0.002  # Its face, the hand's radius [m]; period [s].
# The joints' speed limits [rad/s]. The torque is held for a period, in which a speed at
# its limit would overshoot: hence `between_ticks`.
FASTEST = np.array([1.2, 1.5])
HIGH, LOW, DOWN = [1.5, -0.3], [-0.4, 0.6], 3.0  # [rad], [s].


def controller():
    """Returns Drake's inverse dynamics controller for the arm, a model of its own."""
    arm = MultibodyPlant(time_step=0.0)
    Parser(arm).AddModels(ARM)
    arm.Finalize()
    return InverseDynamicsController(arm, [100.0] * 2, [0.0] * 2, [20.0] * 2, False)


def main() -> None:
    """Swings the arm down and up again and prints how near its hand came."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="2 s only, for a check")
    duration = 2.0 if parser.parse_args().short else 7.0

    builder = DiagramBuilder()
    arm, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    Parser(arm).AddModels(ARM)
    behind = RigidTransform([WALL + 0.05, 0.0, 1.2])
    arm.RegisterVisualGeometry(
        arm.world_body(), behind, Box(0.1, 1.2, 2.4), "wall", [0.6, 0.65, 0.7, 0.5]
    )
    arm.Finalize()
    path = PiecewisePolynomial.CubicShapePreserving(
        [0.0, DOWN, 2.0 * DOWN], np.array([HIGH, LOW, HIGH]).T, True
    )
    wish = builder.AddSystem(TrajectorySource(path, output_derivative_order=1))
    nominal = builder.AddNamedSystem("nominal", controller())
    builder.Connect(wish.get_output_port(), nominal.get_input_port_desired_state())
    builder.Connect(
        arm.get_state_output_port(), nominal.get_input_port_estimated_state()
    )
    hand = point_position(arm, "forearm", [0.5, 0.0, 0.0])
    wall = HalfSpace([-1.0, 0.0, 0.0], offset=-WALL, margin=HAND)
    torque, (shoulder, elbow) = arm.GetEffortUpperLimits(), FASTEST
    safety = AddSafetyFilter(
        builder,
        plant=arm.get_actuation_input_port(),
        reference=nominal.get_output_port_control(),
        barriers=[
            wall.barrier([14.0, 48.0], position=hand, name="wall"),
            *StateLimit(2, -shoulder, shoulder).barriers([15.0], "shoulder speed"),
            *StateLimit(3, -elbow, elbow).barriers([15.0], "elbow speed"),
        ],
        input_set=InputSet.box(-torque, torque),
        bounds=DisturbanceBounds(0.0, 0.0, 0.0),
        settings=FilterSettings(
            period=PERIOD,
            method="vcbf-qp",
            between_ticks="certified",
            # The paper's form: its motors are strong, and the hand goes to the wall.
            volume=VolumeBarrier(gain=3.0, widening=1.0),
        ),
    )
    meshcat = Meshcat(MeshcatParams(host="127.0.0.1", port=0))
    meshcat.SetCameraPose([0.0, -4.0, 1.7], [0.4, 0.0, 1.1])
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
    log = LogVectorOutput(arm.get_state_output_port(), builder)
    status = LogVectorOutput(safety.filter.GetOutputPort("status"), builder, PERIOD)
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    arm.SetPositions(arm.GetMyMutableContextFromRoot(context), HIGH)
    meshcat.StartRecording()
    simulator.AdvanceTo(duration)
    meshcat.PublishRecording()

    x, time = log.FindLog(context).data().T, log.FindLog(context).sample_times()
    h = safety.filter.barrier_set.values_along(x, time)
    points = point_position(arm, "forearm"), hand  # The elbow and the hand.
    places = [[Evaluate(p(q))[[0, 2], 0] for q in x[::20]] for p in points]
    style = {"closed": False, "fill": False, "lw": 2.0, "color": "#39424e"}
    draw(
        "arm_beside_wall",
        [np.array(places[1])],
        [],
        time,
        h,
        unit="m, rad/s",
        axes="xz",
        shapes=[
            Rectangle((WALL, 0.0), 0.1, 2.4, color="#9aa5b4"),
            *(
                Polygon([[0.0, 1.1], *joints], alpha=0.25, **style)
                for joints in list(zip(*places, strict=True))[:75:5]
            ),
        ],
        tall=True,
    )
    Path("out/examples/arm_beside_wall.html").write_text(meshcat.StaticHtml())
    codes = status.FindLog(context).data()
    speeds = np.abs(x[:, 2:]).max(axis=0)
    print(f"min h: {h[:, 0].min():.5f} m, between the ticks too")
    print(f"fastest joints: {speeds.round(4)} rad/s; the limits are {FASTEST}")
    print(f"infeasible ticks: {np.sum(codes >= FilterStatus.INFEASIBLE)}")


if __name__ == "__main__":
    main()
