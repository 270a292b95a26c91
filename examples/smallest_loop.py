"""The smallest loop: a plant, a controller, and the safety filter in between.

Everything here is a Drake system; replace plant and controller by your own. Nothing is
derived by hand: the filter reads the plant's dynamics from the system itself.

    python examples/smallest_loop.py
"""

import argparse

from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput

from vcbf_drake import (
    AddSafetyFilter,
    Blimp,
    BlimpController,
    BlimpControllerParameters,
    DisturbanceSource,
    InputSet,
    SphereObstacle,
)
from vcbf_drake.disturbances import Sinusoid


def main() -> None:
    """Flies a blimp round a sphere in a gusty wind and prints how near it came."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="5 s only, for a check")
    duration = 5.0 if parser.parse_args().short else 30.0

    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", Blimp())
    leaning = BlimpControllerParameters(drift_gain=2.0)  # Else it circles its target.
    controller = builder.AddNamedSystem(
        "controller", BlimpController([4.0, 0.0, 1.0], leaning)
    )
    wind = builder.AddNamedSystem(
        "wind", DisturbanceSource([Sinusoid([0.05, 0.05, 0.0], 0.8, 0.0)], duration)
    )
    builder.Connect(wind.get_output_port(), plant.GetInputPort("disturbance"))
    builder.Connect(plant.GetOutputPort("state"), controller.GetInputPort("state"))
    safety = AddSafetyFilter(
        builder,
        plant=plant,
        reference=controller.GetOutputPort("reference"),
        barriers=[SphereObstacle([2.0, 0.1, 0.5], 0.5).barrier(gains=[4.0, 3.0])],
        input_set=InputSet.box([-0.1, -0.1, -0.01], [0.1, 0.1, 0.01]),
        bounds=wind.bounds,
    )
    barriers = LogVectorOutput(safety.filter.GetOutputPort("barriers"), builder, 0.02)
    diagram = builder.Build()

    simulator = Simulator(diagram)
    simulator.AdvanceTo(duration)

    context = simulator.get_context()
    state = plant.GetOutputPort("state").Eval(plant.GetMyContextFromRoot(context))
    print(f"after {duration:g} s the blimp is at {state[:3].round(2)} m")
    least = barriers.FindLog(context).data().min()
    print(f"least distance to the sphere: {least:.3f} m")


if __name__ == "__main__":
    main()
