"""Obstacles that come through a port: rows, empty and malformed slots, the filter."""

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LinearSystem
import pytest

from tests.helpers.row_gradients import row_gradients
from vcbf_drake import (
    AddSafetyFilter,
    ControlAffineModel,
    InputSet,
    SafetyFilter,
    SphereObstacle,
)
from vcbf_drake.barriers import BarrierSet, HalfSpace, PerceivedSpheres
from vcbf_drake.disturbances import DisturbanceBounds
from vcbf_drake.safety import FilterSettings, FilterStatus, VolumeBarrier

GAINS = [3.0, 2.0]
LIMITS = InputSet.box([-1.0, -1.0], [1.0, 1.0])
X = np.array([0.0, 0.1, 0.6, 0.0])
SEEN = {  # Two obstacles ahead, one of them closing in.
    "centers": [[1.2, 0.0], [0.6, 1.1]],
    "velocities": [[-0.2, 0.1], [0.0, -0.1]],
    "radii": [0.3, 0.4],
}


def point_mass():
    """Two axes of x'' = u."""
    zero, one = np.zeros((2, 2)), np.eye(2)
    A, B = np.block([[zero, one], [zero, zero]]), np.vstack([zero, one])
    return LinearSystem(A=A, B=B, C=np.eye(4))


@pytest.fixture(scope="module")
def model():
    return ControlAffineModel.from_system(point_mass())


def expected_row(x, center, velocity, distance):
    """h, h' and the row of h = |p - c| - R on a point mass, by hand."""
    r, v = x[:2] - center, x[2:] - velocity
    normal = r / np.linalg.norm(r)
    h, rate = np.linalg.norm(r) - distance, normal @ v
    curvature = (v @ v - rate**2) / np.linalg.norm(r)
    return h, rate, -normal, GAINS[0] * rate + GAINS[1] * h + curvature


def test_rows_are_those_of_spheres_that_keep_their_velocity(model):
    spheres = PerceivedSpheres(capacity=3, dimensions=2, margin=0.1)
    barriers = BarrierSet(model, spheres.barriers(GAINS, [0, 1]))
    rng, t = np.random.default_rng(0), 7.3
    for _ in range(10):
        c, v = rng.normal(0.0, 2.0, (2, 3, 2))
        radii, x = rng.uniform(0.1, 1.0, 3), rng.normal(0.0, 2.0, 4)
        obstacles = spheres.pack(c, v, radii)
        rows = barriers.rows(x, t, obstacles)
        for i in range(3):
            h, rate, a, b = expected_row(x, c[i], v[i], radii[i] + 0.1)
            assert rows.value[i] == pytest.approx(h)
            assert rows.chain[i] == pytest.approx([h, rate + 2.0 * h])
            assert rows.A[i] == pytest.approx(a)
            assert rows.b[i] == pytest.approx(b)
            # What time does to the row is what the obstacle's motion does to it.
            step = 1e-6
            late, early = (
                expected_row(x, c[i] + s * v[i], v[i], radii[i] + 0.1)
                for s in (step, -step)
            )
            slope = (np.append(late[2], late[3]) - np.append(*early[2:])) / (2 * step)
            found = [*row_gradients(rows).A[i, :, -1], row_gradients(rows).b[i, -1]]
            assert found == pytest.approx(slope, abs=1e-6)
        assert barriers.values(x, t, obstacles) == pytest.approx(rows.value)


def test_squared_form_and_trajectories(model):
    spheres = PerceivedSpheres(capacity=2, dimensions=2, form="squared")
    barriers = BarrierSet(model, spheres.barriers(GAINS, [0, 1]))
    seen = np.array([spheres.pack([[s, 0.0]], [[1.0, 0.0]], [0.5]) for s in (3.0, 4.0)])
    h = barriers.values_along(np.zeros((2, 4)), np.array([3.0, 4.0]), seen)
    assert h[:, 0] == pytest.approx([9.0 - 0.25, 16.0 - 0.25])
    assert np.isnan(h[:, 1]).all()


def fixed(safety_filter, obstacles=None, time=0.0):
    context = safety_filter.CreateDefaultContext()
    context.SetTime(time)
    ports = {"state": X, "reference": [1.0, 0.0], "held_input": [0.5, 0.25]}
    for name, value in ports.items():
        safety_filter.GetInputPort(name).FixValue(context, np.array(value))
    if obstacles is not None:
        safety_filter.GetInputPort("obstacles").FixValue(context, obstacles)
    return context


def outputs(safety_filter, context, *names):
    return [safety_filter.GetOutputPort(name).Eval(context) for name in names]


def perceiving(model, **options):
    settings = FilterSettings(method="vcbf-qp", **options)
    spheres = PerceivedSpheres(capacity=4, dimensions=2)
    barriers = spheres.barriers(GAINS, [0, 1])
    return spheres, SafetyFilter(model, barriers, LIMITS, settings)


@pytest.mark.parametrize("widening", [1.0, 2.0])
def test_empty_slots_drop_out_exactly(model, widening):
    """Bit for bit the filter that was built with these obstacles and no slots."""
    barrier = VolumeBarrier(widening=widening)
    spheres, safety_filter = perceiving(model, volume=barrier)
    standing = [
        SphereObstacle(c, r, v).barrier(GAINS, [0, 1])
        for c, v, r in zip(*SEEN.values(), strict=True)
    ]
    built = SafetyFilter(model, standing, LIMITS, safety_filter.settings)
    names = ("command", "volume", "slack", "status")
    expected = outputs(built, fixed(built), *names)
    slots = spheres.pack(**SEEN).reshape(4, -1)
    empty = np.array([[np.nan] * 5 + [0.0], [0.0, 0.1, 0.0, 0.0, 9.0, 0.0]])
    for arrangement in (slots[:2], empty), (empty, slots[:2]):
        context = fixed(safety_filter, np.vstack(arrangement).ravel())
        found = outputs(safety_filter, context, *names)
        assert all(map(np.array_equal, found, expected))
    assert expected[3][0] == FilterStatus.FILTERED
    assert np.isnan(outputs(safety_filter, context, "barriers")[0]).tolist() == [
        True,
        True,
        False,
        False,
    ]


def test_nothing_in_sight_leaves_the_reference_alone(model):
    spheres, safety_filter = perceiving(model)
    context = fixed(safety_filter, np.zeros(spheres.size))
    u, volume, status = outputs(safety_filter, context, "command", "volume", "status")
    assert u.tolist() == [1.0, 0.0]
    assert volume[0] == pytest.approx(0.98)
    assert status[0] == FilterStatus.REFERENCE


def test_the_volume_moves_with_the_obstacles(model):
    """dV_v/dt against differences of obstacles carried on at their velocities."""
    barrier = VolumeBarrier(threshold=0.02, widening=1.0)
    spheres, safety_filter = perceiving(model, volume=barrier)
    c, v, r = map(np.array, SEEN.values())

    def volume_at(ahead):
        context = fixed(safety_filter, spheres.pack(c + ahead * v, v, r), 2.0 + ahead)
        return safety_filter.volume(context)

    step = 1e-5
    slope = (volume_at(step).value - volume_at(-step).value) / (2.0 * step)
    assert abs(slope) > 0.05
    assert volume_at(0.0).time == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        (5, 0.5),
        (5, np.nan),
        (5, -1.0),
        (4, -0.1),
        (4, np.nan),
        (0, np.inf),
        (2, np.nan),
    ],
)
def test_a_malformed_slot_fails_and_holds_and_is_forgotten(model, entry, value):
    spheres, safety_filter = perceiving(model)
    good = spheres.pack(**SEEN)
    bad = good.copy()
    bad[entry] = value
    context = fixed(safety_filter, bad)
    u, status = outputs(safety_filter, context, "command", "status")
    assert status[0] == FilterStatus.FAILED
    assert u.tolist() == [0.5, 0.25]
    safety_filter.GetInputPort("obstacles").FixValue(context, good)
    assert outputs(safety_filter, context, "status")[0][0] == FilterStatus.FILTERED


def test_more_obstacles_than_slots_are_refused():
    spheres = PerceivedSpheres(capacity=1, dimensions=2)
    with pytest.raises(ValueError, match="2 obstacles, but 1 slots"):
        spheres.pack(**SEEN)
    with pytest.raises(ValueError, match="centers"):
        spheres.pack([[1.0, 2.0, 3.0]], [[0.0, 0.0, 0.0]], [1.0])
    assert not spheres.pack([], [], []).any()


def test_sizes_are_checked(model):
    with pytest.raises(ValueError, match="capacity"):
        PerceivedSpheres(capacity=0)
    with pytest.raises(ValueError, match="2 or 3"):
        PerceivedSpheres(capacity=1, dimensions=4)
    two = [PerceivedSpheres(n, dimensions=2).barriers(GAINS, [0, 1]) for n in (1, 2)]
    with pytest.raises(ValueError, match="capacity"):
        BarrierSet(model, [*two[0], *two[1]])
    with pytest.raises(ValueError, match=r"obstacles: expected shape \(6,\), got None"):
        BarrierSet(model, two[0]).rows(X, 0.0)


def loop(barriers, port=True):
    """A point mass that wants to go along x, with the paper's volume barrier."""
    builder = DiagramBuilder()
    plant = builder.AddSystem(point_mass())
    wish = builder.AddSystem(ConstantVectorSource([0.3, 0.0]))
    seen = builder.AddSystem(ConstantVectorSource([2.0, 0.1, 0.0, 0.0, 0.5, 1.0]))
    safety = AddSafetyFilter(
        builder,
        plant=plant,
        reference=wish.get_output_port(),
        barriers=barriers,
        input_set=LIMITS,
        bounds=DisturbanceBounds(0.0, 0.0, 0.0),
        obstacles=seen.get_output_port() if port else None,
        settings=FilterSettings(volume=VolumeBarrier(gain=3.0, widening=1.0)),
    )
    return Simulator(builder.Build()), safety, plant


def test_the_port_is_connected_and_the_obstacle_avoided():
    one = PerceivedSpheres(1, dimensions=2)
    wall = HalfSpace([0.0, -1.0], -3.0).barrier(GAINS, [0, 1])
    simulator, _, plant = loop([wall, *one.barriers(GAINS, [0, 1])])
    simulator.AdvanceTo(5.0)
    x = plant.GetMyContextFromRoot(
        simulator.get_context()
    ).get_continuous_state_vector()
    distance = np.hypot(x[0] - 2.0, x[1] - 0.1)
    assert 0.5 <= distance < 0.6


def test_a_port_that_is_missing_or_not_wanted_is_named():
    one = PerceivedSpheres(1, dimensions=2)
    simulator, _, _ = loop(one.barriers(GAINS, [0, 1]), port=False)
    with pytest.raises(RuntimeError, match="obstacles"):
        simulator.AdvanceTo(0.1)
    with pytest.raises(ValueError, match="none of the barriers is of PerceivedSpheres"):
        loop([HalfSpace([0.0, -1.0], -3.0).barrier(GAINS, [0, 1])])
