"""A person drives a car with two sliders; the filter keeps it off pillars and fence.

The sliders for throttle and steering are in the browser, beside the scene, for arrow
keys or mouse. Without a person, a script drives at full throttle.

    python examples/teleoperator.py             # drive; the Stop button ends it
    python examples/teleoperator.py --scripted  # the stick drives for 30 s
"""

import argparse

from matplotlib.patches import Rectangle
import numpy as np
from pictures import draw
from pydrake.geometry import Meshcat, MeshcatParams, MeshcatVisualizer, SceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import LogVectorOutput

from vcbf_drake import (
    AddSafetyFilter,
    Car,
    DisturbanceSource,
    FilterSettings,
    InputSet,
    SphereObstacle,
    VolumeBarrier,
)
from vcbf_drake.barriers import Geofence
from vcbf_drake.disturbances import Sinusoid
from vcbf_drake.plants import CarVehicle
from vcbf_drake.safety import FilterStatus
from vcbf_drake.viz import ObstacleGeometry, VehicleGeometry

# The car's half-length is the margin of everything [m].
PILLARS = [
    SphereObstacle([x, y], 0.3, margin=0.25) for x, y in ((1.5, 0.4), (3.2, -0.6))
]
YARD = Geofence([-1.0, -1.8], [5.0, 1.8], margin=0.25)
MOST, PERIOD = np.array([3.0, 2.0]), 0.02  # [N], [rad/s]; control period [s].


class Stick(LeafSystem):
    """The person's commands: sliders, or a script that is always in a hurry."""

    def __init__(self, meshcat):
        super().__init__()
        self._meshcat = meshcat
        self.DeclareVectorOutputPort("wish", 2, self._calc_wish, {self.time_ticket()})
        if meshcat:
            keys = ("ArrowDown", "ArrowUp"), ("ArrowRight", "ArrowLeft")
            for name, (less, more) in zip(("throttle", "steering"), keys, strict=True):
                meshcat.AddSlider(name, -1.0, 1.0, 0.1, 0.0, less, more)

    def _calc_wish(self, context, output):
        if self._meshcat:
            stick = [self._meshcat.GetSliderValue(n) for n in ("throttle", "steering")]
        else:
            t = context.get_time()
            stick = [1.0 if t % 10.0 < 7.0 else -1.0, 0.6 * np.sin(0.9 * t)]
        output.SetFromVector(MOST * stick)


def main() -> None:
    """Drives until the button is pressed, and prints how near it came."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scripted", action="store_true", help="nobody drives, 30 s")
    parser.add_argument("--short", action="store_true", help="scripted, 8 s only")
    arguments = parser.parse_args()
    scripted = arguments.scripted or arguments.short
    duration = 8.0 if arguments.short else 30.0 if scripted else 600.0

    builder = DiagramBuilder()
    scene_graph = builder.AddSystem(SceneGraph())
    meshcat = None if scripted else Meshcat(MeshcatParams(host="127.0.0.1"))
    car = builder.AddNamedSystem("car", Car())
    stick = builder.AddNamedSystem("stick", Stick(meshcat))
    slope = builder.AddSystem(DisturbanceSource([Sinusoid([0.2], 0.7, 0.0)], duration))
    builder.Connect(slope.get_output_port(), car.GetInputPort("disturbance"))
    safety = AddSafetyFilter(
        builder,
        plant=car,
        reference=stick.get_output_port(),
        barriers=[
            *(pillar.barrier([5.0, 4.0]) for pillar in PILLARS),
            *YARD.barriers([5.0, 4.0]),
        ],
        input_set=InputSet.box(-MOST, MOST),
        bounds=slope.bounds,
        # The paper's volume barrier, felt where it cuts: a person wants to steer.
        settings=FilterSettings(
            period=PERIOD, volume=VolumeBarrier(gain=3.0, widening=1.0)
        ),
    )
    VehicleGeometry.AddToBuilder(
        builder, CarVehicle(), car.get_output_port(), scene_graph, "car"
    )
    ObstacleGeometry.AddToBuilder(builder, PILLARS, scene_graph)
    log = LogVectorOutput(car.get_output_port(), builder)
    status = LogVectorOutput(safety.filter.GetOutputPort("status"), builder, PERIOD)
    if meshcat:
        MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
        meshcat.AddButton("Stop", "Escape")
    simulator = Simulator(builder.Build())
    if meshcat:
        simulator.set_target_realtime_rate(1.0)
        print(f"drive at {meshcat.web_url()}")
    context = simulator.get_context()
    while context.get_time() < duration:
        if meshcat and meshcat.GetButtonClicks("Stop"):
            break
        simulator.AdvanceTo(min(context.get_time() + 0.1, duration))

    x, time = log.FindLog(context).data().T, log.FindLog(context).sample_times()
    h = safety.filter.barrier_set.values_along(x, time)
    codes = status.FindLog(context).data()
    solid, dotted = {"color": "#9aa5b4"}, {"fill": False, "ls": ":"}
    discs = [(p.center, p.radius, solid) for p in PILLARS]
    discs += [(p.center, p.safety_distance, dotted) for p in PILLARS]
    fence = Rectangle(YARD.lower, *np.subtract(YARD.upper, YARD.lower), fill=False)
    draw("teleoperator", [x[:, :2]], discs, time, h, shapes=[fence])
    print(f"min h: {h.min():.4f} m, between the ticks too")
    print(f"infeasible ticks: {np.sum(codes >= FilterStatus.INFEASIBLE)}")
    print(f"the wish passed through at {np.mean(codes == 0):.0%} of the ticks")


if __name__ == "__main__":
    main()
