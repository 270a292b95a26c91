"""Every kind of barrier in a running loop: what it says stays true."""

from __future__ import annotations

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput
import pytest

from tests.helpers.paired_cars import paired_cars
from vcbf_drake import AddSafetyFilter, Blimp, BlimpController, Car, InputSet
from vcbf_drake.barriers import (
    BoxObstacle,
    CapsuleObstacle,
    EllipsoidObstacle,
    Geofence,
    HalfSpace,
    PairDistance,
    StateLimit,
)
from vcbf_drake.disturbances import DisturbanceBounds, DisturbanceSource, Sinusoid
from vcbf_drake.safety import FilterSettings

K = (3.0, 2.0)
PERIOD = 0.02  # In seconds.
TURN = np.array([[0.8, -0.6], [0.6, 0.8]])


def run(builder, plant, reference, barriers, limits, start, duration, bounds=None):
    """The states (T, n), with every barrier's values (T, N), between the ticks too."""
    added = AddSafetyFilter(
        builder,
        plant=plant,
        reference=reference,
        barriers=barriers,
        input_set=InputSet.box(-np.array(limits), limits),
        bounds=bounds or DisturbanceBounds(0.0, 0.0, 0.0),
        settings=FilterSettings(period=PERIOD),
    )
    log = LogVectorOutput(plant.GetOutputPort("state"), builder)
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    plant.GetMyMutableContextFromRoot(context).SetContinuousState(start)
    simulator.AdvanceTo(duration)
    found = log.FindLog(context)
    x, t = found.data().T, found.sample_times()
    return x, added.filter.barrier_set.values_along(x, t)


def test_a_blimp_in_wind_stays_in_its_room_and_below_its_speed() -> None:
    builder = DiagramBuilder()
    blimp = builder.AddSystem(Blimp())
    pilot = builder.AddSystem(BlimpController([4.0, 0.0, -1.0]))
    wind = builder.AddSystem(DisturbanceSource([Sinusoid([0.03] * 3, 0.8, 0.0)], 20.0))
    builder.Connect(wind.get_output_port(), blimp.GetInputPort("disturbance"))
    builder.Connect(blimp.GetOutputPort("state"), pilot.GetInputPort("state"))
    barriers = [
        HalfSpace([0.0, 0.0, 1.0], -0.4).barrier(K, name="floor"),
        *Geofence([-np.inf] * 3, [2.5, np.inf, np.inf]).barriers(K),
        *StateLimit(4, upper=0.4).barriers([2.0], name="speed"),
    ]
    reference, limits = pilot.GetOutputPort("reference"), [0.1, 0.1, 0.01]
    start = np.zeros(8)
    x, h = run(builder, blimp, reference, barriers, limits, start, 20.0, wind.bounds)
    assert h.min() >= 0.0
    # It went as far as each of them lets it.
    assert h.min(axis=0) == pytest.approx([0.0, 0.0, 0.0], abs=0.1)
    assert x[-1, 0] > 2.0


@pytest.mark.parametrize(
    "obstacle",
    [
        BoxObstacle([5.0, 0.1], [0.5, 1.0], TURN, margin=0.2),
        BoxObstacle([6.0, 0.1], [0.5, 1.0], velocity=[-0.2, 0.0]),
        CapsuleObstacle([5.0, -2.0], [6.0, 3.0], 0.4),
        EllipsoidObstacle([5.0, 0.1], [0.5, 1.5], TURN, margin=0.2),
    ],
)
def test_a_car_at_full_throttle_stands_before_an_obstacle(obstacle) -> None:
    builder = DiagramBuilder()
    car = builder.AddSystem(Car())
    pedal = builder.AddSystem(ConstantVectorSource([1.0, 0.0]))
    barriers = [obstacle.barrier(K), *StateLimit(2, upper=1.2).barriers([2.0])]
    reference, limits = pedal.get_output_port(), [4.0, 1.0]
    x, h = run(builder, car, reference, barriers, limits, np.zeros(4), 8.0)
    assert h.min() >= 0.0
    assert h[:, 0].min() < 0.3
    assert x[:, 2].max() == pytest.approx(1.2, abs=0.15)


def test_two_cars_that_head_for_each_other_keep_their_distance() -> None:
    builder = DiagramBuilder()
    cars = builder.AddSystem(paired_cars())
    pedals = builder.AddSystem(ConstantVectorSource([1.0, 0.0, 1.0, 0.0]))
    barriers = [PairDistance(0.8).barrier(K, (0, 1), (4, 5))]
    start = [0.0, 0.0, 0.0, 0.0, 6.0, 0.3, 0.0, np.pi]
    reference, limits = pedals.get_output_port(), [4.0, 1.0, 4.0, 1.0]
    x, h = run(builder, cars, reference, barriers, limits, start, 8.0)
    assert h.min() >= 0.0
    distance = np.hypot(x[:, 0] - x[:, 4], x[:, 1] - x[:, 5])
    assert distance.min() == pytest.approx(0.8, abs=0.3)
