"""The filter among Drake systems that know nothing of it."""

from pathlib import Path

import numpy as np
from pydrake.examples import AcrobotPlant, PendulumPlant
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.controllers import (
    DiscreteTimeLinearQuadraticRegulator,
    FiniteHorizonLinearQuadraticRegulatorOptions,
    MakeFiniteHorizonLinearQuadraticRegulator,
)
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import (
    ConstantVectorSource,
    FirstOrderTaylorApproximation,
    LinearSystem,
    LogVectorOutput,
    MatrixGain,
)
import pytest

from tests.helpers.multibody_plants import SEVEN, load
from vcbf_drake import (
    AddSafetyFilter,
    Blimp,
    BlimpController,
    Car,
    CarController,
    ControlAffineModel,
    DisturbanceSource,
    InputSet,
    SphereObstacle,
)
from vcbf_drake.barriers import BarrierSet, HalfSpace, StateLimit
from vcbf_drake.disturbances import DisturbanceBounds, Sinusoid
from vcbf_drake.model import point_position
from vcbf_drake.safety import (
    FilterSettings,
    FilterStatus,
    SafetyFilter,
    VolumeBarrier,
)

CALM = DisturbanceBounds(0.0, 0.0, 0.0)
ARM = Path(__file__).parents[2] / "examples" / "models" / "planar_arm.urdf"
PLANTS = {
    "blimp": (
        Blimp,
        lambda: BlimpController([4.0, 0.0, 1.0]),
        SphereObstacle([1.0, 0.1, 0.3], 0.5),
        InputSet.box([-0.1, -0.1, -0.01], [0.1, 0.1, 0.01]),
        [0.05, 0.05, 0.0],
    ),
    "car": (
        Car,
        lambda: CarController([4.0, 0.0]),
        SphereObstacle([1.5, 0.1], 0.5),
        InputSet.box([-6.0, -2.0], [6.0, 2.0]),
        [0.2],
    ),
}


def add_plant(builder, name, reference=None):
    """Adds a guarded plant in its wind; returns the plant and its filter."""
    make_plant, _, obstacle, input_set, gust = PLANTS[name]
    plant = builder.AddNamedSystem(name, make_plant())
    wind = builder.AddSystem(DisturbanceSource([Sinusoid(gust, 0.8, 0.0)], 4.0))
    builder.Connect(wind.get_output_port(), plant.GetInputPort("disturbance"))
    safety = AddSafetyFilter(
        builder,
        plant=plant,
        reference=reference,
        barriers=[obstacle.barrier([4.0, 3.0])],
        input_set=input_set,
        bounds=wind.bounds,
        name=f"{name}_filter",
    )
    return plant, safety.filter


def add_loop(builder, name):
    """Adds a guarded plant and its controller; returns a log of states and inputs."""
    controller = builder.AddNamedSystem(f"{name}_controller", PLANTS[name][1]())
    plant, safety_filter = add_plant(builder, name, controller.get_output_port())
    builder.Connect(plant.get_output_port(), controller.GetInputPort("state"))
    ports = plant.get_output_port(), safety_filter.GetOutputPort("command")
    return [LogVectorOutput(port, builder, 0.02) for port in ports]


def add_nested_loop(builder, name):
    """The same, the guarded plant being a Diagram with a port for the reference."""
    inner = DiagramBuilder()
    plant, safety_filter = add_plant(inner, name)
    inner.ExportInput(safety_filter.GetInputPort("reference"), "wish")
    inner.ExportOutput(plant.get_output_port(), "state")
    inner.ExportOutput(safety_filter.GetOutputPort("command"), "input")
    guarded = builder.AddNamedSystem("guarded", inner.Build())
    controller = builder.AddSystem(PLANTS[name][1]())
    builder.Connect(guarded.GetOutputPort("state"), controller.GetInputPort("state"))
    builder.Connect(controller.get_output_port(), guarded.GetInputPort("wish"))
    ports = guarded.GetOutputPort("state"), guarded.GetOutputPort("input")
    return [LogVectorOutput(port, builder, 0.02) for port in ports]


def run(*loops, duration=4.0):
    """Runs (add, name) in one diagram; returns each loop's states and inputs."""
    builder = DiagramBuilder()
    logs = [add(builder, name) for add, name in loops]
    simulator = Simulator(builder.Build())
    fixed_step = SimulatorConfig(
        integration_scheme="runge_kutta3", max_step_size=0.01, use_error_control=False
    )
    ApplySimulatorConfig(fixed_step, simulator)
    simulator.AdvanceTo(duration)
    context = simulator.get_context()
    return [[log.FindLog(context).data().copy() for log in each] for each in logs]


def test_two_filters_and_two_plants_give_what_each_gives_alone():
    """Bit for bit, in whatever order they were added."""
    alone = {name: run((add_loop, name))[0] for name in PLANTS}
    assert np.abs(np.diff(alone["blimp"][1])).max() > 1e-3
    for names in ("blimp", "car"), ("car", "blimp"):
        together = run(*((add_loop, name) for name in names))
        for name, found in zip(names, together, strict=True):
            for one, other in zip(found, alone[name], strict=True):
                assert np.array_equal(one, other)


def test_a_guarded_plant_is_a_diagram_like_any_other():
    flat, nested = run((add_loop, "blimp")), run((add_nested_loop, "blimp"))
    for one, other in zip(flat[0], nested[0], strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize("make_plant", [Blimp, Car])
def test_drake_linearises_the_plants(make_plant):
    """Against central differences of the model that the filter derives."""
    plant = make_plant()
    model = ControlAffineModel.from_system(plant)
    n, m = model.num_states, model.num_inputs
    rng = np.random.default_rng(7)
    x, u = rng.uniform(0.2, 0.8, n), rng.uniform(-0.1, 0.1, m)
    context = plant.CreateDefaultContext()
    context.SetContinuousState(x)
    plant.GetInputPort("input").FixValue(context, u)
    linear = FirstOrderTaylorApproximation(
        plant,
        context,
        plant.GetInputPort("input").get_index(),
        plant.GetOutputPort("state").get_index(),
    )

    def rate(x):
        return model.drift(x) + model.input_matrix(x) @ u

    slopes = [(rate(x + dx) - rate(x - dx)) / 2e-5 for dx in 1e-5 * np.eye(n)]
    np.testing.assert_allclose(linear.A(), np.transpose(slopes), atol=1e-8)
    np.testing.assert_allclose(linear.B(), model.input_matrix(x), atol=1e-12)


def point_mass():
    """Returns x'' = u along one axis."""
    return LinearSystem([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], np.eye(2))


def discrete_lqr():
    A, B = np.array([[1.0, 0.02], [0.0, 1.0]]), np.array([[2e-4], [0.02]])
    gain, _ = DiscreteTimeLinearQuadraticRegulator(A, B, np.eye(2), [[0.1]])
    return MatrixGain(-gain)


def finite_horizon_lqr():
    options = FiniteHorizonLinearQuadraticRegulatorOptions()
    options.Qf = 10.0 * np.eye(2)
    plant = point_mass()
    context = plant.CreateDefaultContext()
    plant.get_input_port().FixValue(context, [0.0])
    return MakeFiniteHorizonLinearQuadraticRegulator(
        plant, context, 0.0, 5.0, np.eye(2), [[0.1]], options
    )


@pytest.mark.parametrize("make_lqr", [discrete_lqr, finite_horizon_lqr])
def test_drakes_regulators_are_filtered(make_lqr):
    """They bring a mass to the origin; the filter lets it come no faster than 0.5."""
    builder = DiagramBuilder()
    plant, lqr = builder.AddSystem(point_mass()), builder.AddSystem(make_lqr())
    builder.Connect(plant.get_output_port(), lqr.get_input_port())
    AddSafetyFilter(
        builder,
        plant=plant,
        reference=lqr.get_output_port(),
        barriers=StateLimit(1, lower=-0.5).barriers([5.0]),
        input_set=InputSet.box([-3.0], [3.0]),
        bounds=CALM,
    )
    log = LogVectorOutput(plant.get_output_port(), builder)
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    plant.GetMyMutableContextFromRoot(context).SetContinuousState([1.5, 0.0])
    simulator.AdvanceTo(5.0)
    x = log.FindLog(context).data()
    assert -0.5 - 1e-9 <= x[1].min() < -0.45
    assert abs(x[0, -1]) < 0.1


@pytest.mark.parametrize(
    ("plant", "state", "push", "most"),
    [(PendulumPlant(), 0, 1.0, 0.2), (AcrobotPlant(), 3, 4.0, 1.0)],
)
def test_drakes_examples_keep_a_limit(plant, state, push, most):
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    reference = builder.AddSystem(ConstantVectorSource([push]))
    degree = [10.0, 25.0] if state == 0 else [5.0]
    safety = AddSafetyFilter(
        builder,
        plant=plant,
        reference=reference.get_output_port(),
        barriers=StateLimit(state, upper=most).barriers(degree),
        input_set=InputSet.box([-10.0], [10.0]),
        bounds=CALM,
        settings=FilterSettings(period=0.005),
        state=plant.get_state_output_port()
        if hasattr(plant, "get_state_output_port")
        else plant.get_output_port(0),
    )
    log = LogVectorOutput(safety.filter.GetOutputPort("barriers"), builder, 0.005)
    status = LogVectorOutput(safety.filter.GetOutputPort("status"), builder, 0.005)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(1.5)
    context = simulator.get_context()
    h = log.FindLog(context).data()
    assert -0.01 * most < h.min() < 0.1 * most
    assert status.FindLog(context).data().max() == FilterStatus.FILTERED


def test_a_discrete_plant_is_filtered_with_its_continuous_twins_model():
    """An arm that Drake steps in time falls towards a wall and stops short."""

    def arm(time_step):
        plant = MultibodyPlant(time_step)
        Parser(plant).AddModels(ARM)
        plant.Finalize()
        return plant

    twin = arm(0.0)
    builder = DiagramBuilder()
    plant = builder.AddSystem(arm(1e-3))
    idle = builder.AddSystem(ConstantVectorSource([0.0, 0.0]))
    hand = point_position(twin, "forearm", [0.5, 0.0, 0.0])
    wall = HalfSpace([-1.0, 0.0, 0.0], offset=-0.73)
    safety = AddSafetyFilter(
        builder,
        plant=plant.GetInputPort("actuation"),
        model=ControlAffineModel.from_system(twin, "actuation"),
        reference=idle.get_output_port(),
        barriers=[wall.barrier([20.0, 100.0], position=hand)],
        input_set=InputSet.box([-80.0, -40.0], [80.0, 40.0]),
        bounds=CALM,
        settings=FilterSettings(period=0.002),
    )
    log = LogVectorOutput(safety.filter.GetOutputPort("barriers"), builder, 0.002)
    status = LogVectorOutput(safety.filter.GetOutputPort("status"), builder, 0.002)
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    plant.SetPositions(plant.GetMyMutableContextFromRoot(context), [1.2, -0.8])
    simulator.AdvanceTo(1.0)
    h = log.FindLog(context).data()
    assert -1e-3 < h.min() < 0.02
    # Unfiltered it would fall 0.11 m beyond the wall.
    codes = status.FindLog(context).data()
    assert FilterStatus.FILTERED in codes and codes.max() <= FilterStatus.RELAXED


def test_a_parameter_set_in_a_context_changes_the_plant_and_not_the_filter():
    car = Car()
    context = car.CreateDefaultContext()
    mass = context.get_numeric_parameter(0).CopyToVector()
    car.GetInputPort("disturbance").FixValue(context, [0.0])
    car.GetInputPort("input").FixValue(context, [1.0, 0.0])
    before = ControlAffineModel.from_system(car)
    rate = car.EvalTimeDerivatives(context).CopyToVector()
    context.get_mutable_numeric_parameter(0).SetFromVector(2.0 * mass)
    heavy = car.EvalTimeDerivatives(context).CopyToVector()
    x, u = np.zeros(4), np.array([1.0, 0.0])
    assert heavy[2] == pytest.approx(0.5 * rate[2]) and rate[2] > 0.0
    assert before.drift(x) + before.input_matrix(x) @ u == pytest.approx(rate)
    after = ControlAffineModel.from_system(car, context=context)
    assert after.drift(x) + after.input_matrix(x) @ u == pytest.approx(heavy)


@pytest.mark.slow
def test_a_floating_body_has_quaternion_states():
    """Drake's default floating base, pushed by a generalised force."""
    plant = MultibodyPlant(time_step=0.0)
    box = SpatialInertia(1.5, [0.0] * 3, UnitInertia.SolidBox(0.3, 0.2, 0.1))
    plant.AddRigidBody("body", box)
    plant.Finalize()
    port = plant.GetInputPort("applied_generalized_force")
    model = ControlAffineModel.from_system(plant, port)
    context = plant.CreateDefaultContext()
    rng = np.random.default_rng(0)
    for _ in range(5):
        x, u = rng.normal(size=13), rng.normal(size=6)
        x[:4] /= np.linalg.norm(x[:4])
        context.SetContinuousState(x)
        port.FixValue(context, u)
        rate = plant.EvalTimeDerivatives(context).CopyToVector()
        assert model.drift(x) + model.input_matrix(x) @ u == pytest.approx(rate)
    ball = SphereObstacle([2.0, 2.0, 2.0], 0.5)
    barrier = ball.barrier([3.0, 2.0], position=point_position(plant, "body"))
    value = BarrierSet(model, [barrier]).values(x, 0.0)
    assert value[0] == pytest.approx(np.linalg.norm(x[4:7] - 2.0) - 0.5)


@pytest.mark.parametrize(
    ("gain", "status"), [(3.0, FilterStatus.FILTERED), (0.01, FilterStatus.RELAXED)]
)
def test_strong_actuators_between_narrow_limits_keep_a_volume_row_that_counts(
    gain, status
):
    """Seven joints whose torques are far more than their speed limits need.

    Their sets start at det B = 1e-14 or so: a volume barrier without a threshold takes
    a tenth of that, and its row holds, or gives way, like any other.
    """
    plant = load(SEVEN)
    limit, torque = plant.GetVelocityUpperLimits(), plant.GetEffortUpperLimits()
    barriers = [
        barrier
        for i in range(7)
        for barrier in StateLimit(7 + i, -limit[i], limit[i]).barriers([12.0])
    ]
    safety_filter = SafetyFilter(
        ControlAffineModel.from_system(plant),
        barriers,
        InputSet.box(-torque, torque),
        FilterSettings(method="vcbf-qp", volume=VolumeBarrier(gain=gain, widening=1.0)),
    )
    context = safety_filter.CreateDefaultContext()
    state = [0.2, 0.7, -0.3, 0.9, 0.2, -0.5, 0.3, 1.5, -1.2, 1.4, 1.5, -1.8, 2.2, 2.0]
    safety_filter.GetInputPort("state").FixValue(context, state)
    safety_filter.GetInputPort("reference").FixValue(context, 0.3 * torque)
    volume = safety_filter.volume(context)
    assert volume is not None and 0.0 < volume.value < 1e-9
    decision = safety_filter.decision(context)
    assert decision.status == status
    assert (decision.slack < 0.0) == (status == FilterStatus.RELAXED)
