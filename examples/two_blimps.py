"""Two blimps change places while a ball, unknown in advance, rises between them.

One filter serves both: its plant is a diagram of two blimps, with 16 states and 6
inputs, and one barrier more keeps them apart. The filter does not know the ball: a
sensor reports it through the port `obstacles`.

    python examples/two_blimps.py
"""

import argparse
from pathlib import Path

import numpy as np
from pictures import draw
from pydrake.geometry import SceneGraph, Sphere
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import Demultiplexer, LogVectorOutput, Multiplexer

from vcbf_drake import (
    AddSafetyFilter,
    Blimp,
    BlimpController,
    BlimpControllerParameters,
    DisturbanceSource,
    FilterSettings,
    InputSet,
    VolumeBarrier,
)
from vcbf_drake.barriers import PairDistance, PerceivedSpheres
from vcbf_drake.disturbances import Sinusoid
from vcbf_drake.plants import BlimpVehicle, Part
from vcbf_drake.safety import FilterStatus
from vcbf_drake.viz import VehicleGeometry, write_diagram_replay
from vcbf_drake.viz.scene_graph import PosedGeometry

STARTS = [[0.0, 0.0, 1.0, 0.0], [6.0, 0.1, 1.1, np.pi]]  # x, y, z [m], yaw [rad].
TARGETS = [[6.0, 0.0, 1.0], [0.0, 0.1, 1.1]]  # [m]
FIRST, SECOND = (0, 1, 2), (8, 9, 10)  # Which states are their positions.
# Perception may report up to two spheres at a time; both blimps keep 0.3 m from each.
SPHERES = PerceivedSpheres(capacity=2, margin=0.3)
BALL, RANGE = 0.4, 2.5  # The ball's radius, how far the blimps can see [m].
APART, PERIOD = 0.8, 0.02  # Between the blimps' centres [m]; control period [s].
GAINS = [3.0, 2.0]


def ball(t):
    """Returns where the ball is at time t: it rises and sways."""
    return np.array([3.0 + 0.3 * np.sin(0.4 * t), 0.1, 0.4 + 0.1 * t])


def ball_velocity(t):
    """Returns how fast it moves; the filter takes it to go on like that."""
    return np.array([0.12 * np.cos(0.4 * t), 0.0, 0.1])


class Ball(PosedGeometry):
    """The ball, for the eye."""

    def __init__(self, scene_graph):
        super().__init__(scene_graph, {"ball": [Part("body", Sphere(BALL), "#9aa5b4")]})

    def poses(self, context):
        """Returns where it is."""
        return [RigidTransform(ball(context.get_time()))]


class Perception(LeafSystem):
    """Sees the ball from either blimp, when it is near enough."""

    def __init__(self):
        super().__init__()
        self._state = self.DeclareVectorInputPort("state", 16)
        self.DeclareVectorOutputPort("obstacles", SPHERES.size, self._calc_obstacles)

    def _calc_obstacles(self, context, output):
        x, t = self._state.Eval(context), context.get_time()
        away = [np.linalg.norm(x[[*blimp]] - ball(t)) for blimp in (FIRST, SECOND)]
        found = min(away) < RANGE
        spheres = ([ball(t)], [ball_velocity(t)], [BALL]) if found else ([], [], [])
        output.SetFromVector(SPHERES.pack(*spheres))


def pair():
    """Returns two blimps as one plant: their states, inputs and winds stacked."""
    builder = DiagramBuilder()
    state = builder.AddSystem(Multiplexer([8, 8]))
    split = {
        name: builder.AddSystem(Demultiplexer([3, 3]))
        for name in ("input", "disturbance")
    }
    for i in range(2):
        blimp = builder.AddNamedSystem(f"blimp_{i}", Blimp())
        builder.Connect(blimp.get_output_port(), state.get_input_port(i))
        for name, each in split.items():
            builder.Connect(each.get_output_port(i), blimp.GetInputPort(name))
    for name, each in split.items():
        builder.ExportInput(each.get_input_port(), name)
    builder.ExportOutput(state.get_output_port(), "state")
    return builder.Build()


def main() -> None:
    """Flies both to where the other one started."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="6 s only, for a check")
    duration = 6.0 if parser.parse_args().short else 20.0

    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", pair())
    breeze = [Sinusoid([0.02, 0.01, 0.0, 0.02, -0.01, 0.0], 0.6, 0.0)]
    wind = builder.AddSystem(DisturbanceSource(breeze, duration))
    builder.Connect(wind.get_output_port(), plant.GetInputPort("disturbance"))
    states = builder.AddSystem(Demultiplexer([8, 8]))
    reference = builder.AddSystem(Multiplexer([3, 3]))
    builder.Connect(plant.get_output_port(), states.get_input_port())
    for i, target in enumerate(TARGETS):
        leaning = BlimpControllerParameters(drift_gain=2.0)
        controller = builder.AddNamedSystem(
            f"controller_{i}", BlimpController(target, leaning)
        )
        builder.Connect(states.get_output_port(i), controller.GetInputPort("state"))
        builder.Connect(controller.get_output_port(), reference.get_input_port(i))
    perception = builder.AddNamedSystem("perception", Perception())
    builder.Connect(plant.get_output_port(), perception.get_input_port())
    most = np.tile([0.1, 0.1, 0.01], 2)
    safety = AddSafetyFilter(
        builder,
        plant=plant,
        reference=reference.get_output_port(),
        barriers=[
            PairDistance(APART).barrier(GAINS, FIRST, SECOND),
            *SPHERES.barriers(GAINS, position=FIRST, name="first sees"),
            *SPHERES.barriers(GAINS, position=SECOND, name="second sees"),
        ],
        obstacles=perception.get_output_port(),
        input_set=InputSet.box(-most, most),
        bounds=wind.bounds,
        # The paper's volume barrier, felt where it cuts: they pass close by.
        settings=FilterSettings(
            period=PERIOD, volume=VolumeBarrier(gain=3.0, widening=1.0)
        ),
    )
    scene_graph = builder.AddSystem(SceneGraph())
    builder.AddSystem(Ball(scene_graph)).ConnectTo(builder, scene_graph)
    for i, color in enumerate(("#0072b2", "#d55e00")):
        VehicleGeometry.AddToBuilder(
            builder,
            BlimpVehicle(),
            states.get_output_port(i),
            scene_graph,
            f"blimp {i}",
            color,
        )
    log = LogVectorOutput(plant.get_output_port(), builder)
    status = LogVectorOutput(safety.filter.GetOutputPort("status"), builder, PERIOD)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    start = np.concatenate([[*each, 0.0, 0.0, 0.0, 0.0] for each in STARTS])
    plant.GetMyMutableContextFromRoot(context).SetContinuousState(start)
    replay = Path("out/examples/two_blimps.html")
    title = "Two blimps change places"
    write_diagram_replay(diagram, replay, duration, context, title)
    simulator.AdvanceTo(duration)

    x, time = log.FindLog(context).data().T, log.FindLog(context).sample_times()
    centers = np.array([ball(t) for t in time])
    gaps = [np.linalg.norm(x[:, each] - centers, axis=1) for each in (FIRST, SECOND)]
    pair_gap = np.linalg.norm(x[:, FIRST] - x[:, SECOND], axis=1)
    h = np.column_stack([pair_gap - APART, *(gap - BALL - 0.3 for gap in gaps)])
    codes = status.FindLog(context).data()
    discs = [
        (ball(t)[[0, 2]], BALL, {"color": "#9aa5b4", "alpha": 0.4})
        for t in np.linspace(0.0, duration, 4)
    ]
    paths = [x[:, [0, 2]], x[:, [8, 10]]]  # From the side.
    draw("two_blimps", paths, discs, time, h, top=2.0, axes="xz")
    left = [
        np.linalg.norm(x[-1, i : i + 3] - target)
        for i, target in zip((0, 8), TARGETS, strict=True)
    ]
    print(f"min h: {h.min():.5f} m; to the targets: {left[0]:.2f} m, {left[1]:.2f} m")
    print(f"infeasible ticks: {np.sum(codes >= FilterStatus.INFEASIBLE)}")
    print(f"replay: {replay}")
    print(f"volume row relaxed at {np.sum(codes == FilterStatus.RELAXED)} ticks")


if __name__ == "__main__":
    main()
