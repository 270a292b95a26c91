"""A barrier of your own: a car must stay in a ring that moves and changes its size.

h(x, t, p) is a function written with NumPy; the library derives its derivatives along
the plant and in time.

    python examples/own_barrier.py
"""

import argparse

import numpy as np
from pictures import draw
from pydrake.math import cos, sin
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput

from vcbf_drake import (
    AddSafetyFilter,
    Barrier,
    Car,
    CarController,
    DisturbanceSource,
    FilterSettings,
    InputSet,
)
from vcbf_drake.disturbances import Sinusoid
from vcbf_drake.safety import FilterStatus

PERIOD = 0.02  # [s]
# The ring's mean radius, its breath [m] and the breath's rate [rad/s], and how fast it
# moves on [m/s]. A row holds at the ticks: a ring that is much faster than this one
# catches the car by a millimetre between two ticks. AddSafetyFilter's between_ticks
# prevents that.
RING = (1.6, 0.5, 0.4, 0.2)


def ring(t, p):
    """Returns the ring's centre and radius at time t."""
    radius, breath, rate, speed = p
    return np.array([speed * t, 0.8 * sin(0.2 * t)]), radius + breath * cos(rate * t)


def inside(x, t, p):
    """Returns h = R(t)^2 - |p - c(t)|^2 [m^2], smooth at the centre too."""
    center, radius = ring(t, p)
    offset = x[:2] - center
    return radius**2 - offset @ offset


def main() -> None:
    """Drives a car that would rather hurry ahead to a target far away."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="8 s only, for a check")
    duration = 8.0 if parser.parse_args().short else 40.0

    builder = DiagramBuilder()
    car = builder.AddNamedSystem("car", Car())
    driver = builder.AddNamedSystem("driver", CarController([12.0, 0.0]))
    slope = builder.AddSystem(DisturbanceSource([Sinusoid([0.2], 0.7, 0.0)], duration))
    builder.Connect(car.get_output_port(), driver.GetInputPort("state"))
    builder.Connect(slope.get_output_port(), car.GetInputPort("disturbance"))
    safety = AddSafetyFilter(
        builder,
        plant=car,
        reference=driver.GetOutputPort("reference"),
        barriers=[Barrier(inside, gains=[3.0, 2.0], parameters=RING, name="ring")],
        input_set=InputSet.box([-6.0, -2.0], [6.0, 2.0]),
        bounds=slope.bounds,
        settings=FilterSettings(period=PERIOD),
    )
    state = LogVectorOutput(car.get_output_port(), builder)
    status = LogVectorOutput(safety.filter.GetOutputPort("status"), builder, PERIOD)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(duration)

    context = simulator.get_context()
    log, codes = state.FindLog(context), status.FindLog(context).data()
    x, time = log.data().T, log.sample_times()
    h = safety.filter.barrier_set.values_along(x, time)
    style = {"fill": False, "color": "#e69f00"}
    rings = [(*ring(t, RING), style) for t in np.linspace(0.0, duration, 6)]
    draw("own_barrier", [x[:, :2]], rings, time, h, unit="m²")
    print(f"min h: {h.min():.4f} m^2, between the ticks too")
    print(f"the car came {x[-1, 0]:.1f} m far, the ring {RING[3] * duration:.1f} m")
    print(f"infeasible ticks: {np.sum(codes >= FilterStatus.INFEASIBLE)}")


if __name__ == "__main__":
    main()
