from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.common import FindResourceOrThrow
from pydrake.examples import AcrobotPlant, PendulumPlant, QuadrotorPlant
from pydrake.math import abs, sin, sqrt
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    PrismaticJoint,
    SpatialInertia,
    UnitInertia,
)
from pydrake.systems.controllers import PidController
from pydrake.systems.framework import (
    BasicVector_,
    Diagram,
    DiagramBuilder,
    LeafSystem,
    LeafSystem_,
)
from pydrake.systems.primitives import (
    FirstOrderLowPassFilter,
    Integrator,
    LinearSystem,
)
from pydrake.systems.scalar_conversion import TemplateSystem
import pytest

from tests.helpers.multibody_plants import PLANAR, load
from vcbf_drake.errors import ModelError
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Blimp, BlimpParameters, Car

CART_POLE = FindResourceOrThrow("drake/examples/multibody/cart_pole/cart_pole.sdf")


@TemplateSystem.define("Formula_")
def Formula_(T: type) -> type:
    class Impl(LeafSystem_[T]):
        """A plant of two states whose rate is any function of (t, x, u, d, p)."""

        def _construct(
            self,
            rate: Callable[..., list[Any]],
            num_inputs: int = 1,
            num_disturbances: int = 1,
            other_size: int = 0,
            converter: Any = None,
        ) -> None:
            LeafSystem_[T].__init__(self, converter=converter)
            self.arguments = rate, num_inputs, num_disturbances, other_size
            self.rate = rate
            self.DeclareContinuousState(2)
            self.DeclareNumericParameter(BasicVector_[T]([3.0]))
            self.u = self.DeclareVectorInputPort("input", num_inputs)
            self.d = self.DeclareVectorInputPort("disturbance", num_disturbances)
            self.other = other_size and self.DeclareVectorInputPort("other", other_size)

        def _construct_copy(self, other: Any, converter: Any = None) -> None:
            Impl._construct(self, *other.arguments, converter=converter)

        def DoCalcTimeDerivatives(self, context: Any, derivatives: Any) -> None:
            rate = self.rate(
                context.get_time(),
                context.get_continuous_state_vector().CopyToVector(),
                self.u.Eval(context),
                self.d.Eval(context),
                self.other.Eval(context)
                if self.other
                else context.get_numeric_parameter(0).CopyToVector(),
            )
            derivatives.SetFromVector(np.array(rate))

    return Impl


Formula = Formula_[None]


def linear_system() -> LinearSystem:
    random = np.random.default_rng(3)
    return LinearSystem(
        A=random.normal(size=(3, 3)), B=random.normal(size=(3, 2)), C=np.eye(3)
    )


def diagram(plant: Any, port: str) -> Diagram:
    builder = DiagramBuilder()
    builder.AddNamedSystem("plant", plant)
    builder.ExportInput(plant.GetInputPort(port), "input")
    return builder.Build()


def assert_agrees(model: ControlAffineModel, port: Any, context: Any) -> None:
    """Compares f + g u + E d with Drake's own derivatives at random points."""
    system = port.get_system()
    random = np.random.default_rng(0)
    for _ in range(10):
        x = random.normal(size=model.num_states)
        u = random.normal(size=model.num_inputs)
        d = random.normal(size=model.num_disturbances)
        context.SetContinuousState(x)
        port.FixValue(context, u)
        if model.num_disturbances:
            system.GetInputPort("disturbance").FixValue(context, d)
        f, g = model.drift_and_input_matrix(x)
        rate = f + g @ u + model.disturbance_matrix @ d
        expected = system.EvalTimeDerivatives(context).CopyToVector()
        np.testing.assert_allclose(rate, expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(model.drift(x), f)
        np.testing.assert_array_equal(model.input_matrix(x), g)


@pytest.mark.parametrize(
    ("system", "port"),
    [
        (Blimp(), "input"),
        (Blimp(BlimpParameters(added_mass=[0.1, 0.3, 0.2])), "input"),
        (Car(), "input"),
        (PendulumPlant(), "tau"),
        (AcrobotPlant(), "elbow_torque"),
        (QuadrotorPlant(), "propeller_force"),
        (linear_system(), "u0"),
        (load(CART_POLE), "actuation"),
        (load(PLANAR), "actuation"),
        (diagram(Blimp(), "input"), "input"),
        (diagram(load(CART_POLE), "actuation"), "input"),
        (Formula(lambda t, x, u, d, p: [sqrt(1.5 + sin(x[0])), u[0] + d[0]]), "input"),
    ],
)
def test_model_agrees_with_the_system(system: Any, port: str) -> None:
    model = ControlAffineModel.from_system(system, port)
    assert_agrees(model, system.GetInputPort(port), system.CreateDefaultContext())


def test_parameters_come_from_the_context() -> None:
    blimp = Blimp()
    context = blimp.CreateDefaultContext()
    parameters = context.get_mutable_numeric_parameter(0)
    parameters.SetFromVector(1.7 * parameters.CopyToVector())
    model = ControlAffineModel.from_system(blimp, context=context)
    assert_agrees(model, blimp.GetInputPort("input"), context)
    default = ControlAffineModel.from_system(blimp)
    x = np.ones(8)
    assert not np.allclose(model.input_matrix(x), default.input_matrix(x))


def test_blimp_model_has_names_shapes_and_the_disturbed_channels() -> None:
    model = ControlAffineModel.from_system(Blimp())
    assert (model.num_states, model.num_inputs, model.num_disturbances) == (8, 3, 3)
    assert model.state_names == ("x", "y", "z", "yaw", "vx", "vy", "vz", "yaw_rate")
    assert model.state.shape == np.shape(model.dynamics.f) == (8,)
    assert np.shape(model.dynamics.g) == (8, 3)
    np.testing.assert_array_equal(model.disturbance_matrix, np.eye(8)[:, 4:7])


def test_states_are_named_as_the_system_names_them() -> None:
    plant = load(PLANAR)
    model = ControlAffineModel.from_system(plant, "actuation")
    assert model.state_names == tuple(plant.GetStateNames())
    assert ControlAffineModel.from_system(PendulumPlant()).state_names == ("x0", "x1")


def test_ports_are_given_by_object_name_or_index() -> None:
    car = Car()
    x = np.array([1.0, 2.0, 3.0, 4.0])
    expected = ControlAffineModel.from_system(car)
    for port in (car.GetInputPort("input"), "input", 0, np.int64(0)):
        model = ControlAffineModel.from_system(
            car, port, disturbance_port="disturbance"
        )
        np.testing.assert_array_equal(model.input_matrix(x), expected.input_matrix(x))
    swapped = ControlAffineModel.from_system(car, "disturbance", "input")
    np.testing.assert_array_equal(swapped.input_matrix(x), [[0], [0], [1], [0]])
    np.testing.assert_array_equal(swapped.disturbance_matrix, expected.input_matrix(x))


def test_a_system_without_a_disturbance_has_none() -> None:
    model = ControlAffineModel.from_system(AcrobotPlant())
    assert model.num_disturbances == 0
    assert model.disturbance_matrix.shape == (4, 0)


def test_other_ports_are_held_at_zero_or_at_their_value_in_the_context() -> None:
    system = Formula(lambda t, x, u, d, o: [o[0] * x[1], u[0] + d[0]], other_size=1)
    x = np.array([5.0, 2.0])
    model = ControlAffineModel.from_system(system, "input")
    np.testing.assert_array_equal(model.drift(x), [0.0, 0.0])
    context = system.CreateDefaultContext()
    system.GetInputPort("other").FixValue(context, [3.0])
    model = ControlAffineModel.from_system(system, "input", context=context)
    np.testing.assert_array_equal(model.drift(x), [6.0, 0.0])


def test_an_affine_form_may_want_simplification() -> None:
    def rate(t: Any, x: Any, u: Any, d: Any, p: Any) -> list[Any]:
        return [(u[0] + x[1]) ** 2 - u[0] ** 2, d[0] * (x[0] / (2.0 * x[0]))]

    model = ControlAffineModel.from_system(Formula(rate))
    np.testing.assert_allclose(model.input_matrix(np.array([1.0, 4.0])), [[8.0], [0.0]])
    np.testing.assert_allclose(model.disturbance_matrix, [[0.0], [0.5]])


@pytest.mark.parametrize(
    ("rate", "message"),
    [
        (lambda t, x, u, d, p: [x[1], u[0] ** 2 + d[0]], "derivative of x1 is not aff"),
        (lambda t, x, u, d, p: [sin(u[0]), d[0]], "derivative of x0 is not affine"),
        (lambda t, x, u, d, p: [x[1] + d[0], u[0] * d[0]], "x1 is not affine"),
        (lambda t, x, u, d, p: [x[1], u[0] + d[0] ** 3], "x1 is not affine"),
        (lambda t, x, u, d, p: [x[1], abs(u[0]) + d[0]], "x1 is not affine"),
        (lambda t, x, u, d, p: [1.0 / u[0], d[0]], "x0 is not affine"),
        (
            lambda t, x, u, d, p: [x[1], u[0] + x[0] * d[0]],
            "disturbance 0 acts on.* x1",
        ),
        (lambda t, x, u, d, p: [sqrt(x[0]) * d[0], u[0]], "E is not constant"),
        (lambda t, x, u, d, p: [x[1], u[0]], "columns of the disturbance matrix"),
        (lambda t, x, u, d, p: [t * x[1], u[0] + d[0]], "of x0 depends on time"),
        (lambda t, x, u, d, p: [x[1], u[0] + d[0] if x[0] > 0 else 0], "do not eval"),
        (lambda t, x, u, d, p: [x[1], u[0] + d[0] + np.nan * x[0]], "NaN has no count"),
    ],
)
def test_what_is_not_affine_is_refused_by_name(
    rate: Callable[..., list[Any]], message: str
) -> None:
    system = Formula(rate)
    system.set_name("the_plant")
    with pytest.raises(ModelError, match=f"the_plant.*{message}"):
        ControlAffineModel.from_system(system)


def test_effort_limits_in_a_diagram_are_refused_with_what_to_do() -> None:
    for symbolic in (False, True):
        with pytest.raises(ModelError, match="RemoveAllJointActuatorEffortLimits"):
            system = diagram(load(PLANAR), "actuation")
            ControlAffineModel.from_system(system, symbolic=symbolic)


def drag(t: Any, x: Any, u: Any, d: Any, p: Any) -> list[Any]:
    """A cart whose drag is against its motion, |v| v: here +4 at v = -2."""
    return [x[1], u[0] + d[0] - (x[1] * x[1]) ** 0.5 * x[1]]


@pytest.mark.parametrize(
    "rate",
    [
        drag,
        lambda t, x, u, d, p: [x[1], u[0] + d[0] - ((x[1] / 3) ** 4) ** 0.25],
        lambda t, x, u, d, p: [(x[1] ** 2) ** 1.5, u[0] + d[0]],
        lambda t, x, u, d, p: [x[1], ((x[0] - 2.0) ** 2) ** 0.5 * u[0] + d[0]],
        lambda t, x, u, d, p: [x[1], u[0] + d[0] + ((p[0] * x[0]) ** 2) ** 0.5],
        lambda t, x, u, d, p: [x[1], u[0] + d[0] + (x[0] ** 2) ** 0.25],
    ],
)
def test_a_plant_that_its_symbols_misread_is_refused(rate: Any) -> None:
    plant = Formula(rate)
    context = plant.CreateDefaultContext()
    for name in ("input", "disturbance"):
        plant.GetInputPort(name).FixValue(context, [0.0])
    context.SetContinuousState([-1.0, -2.0])
    own = plant.EvalTimeDerivatives(context).CopyToVector()
    np.testing.assert_allclose(own, np.array(rate(0, [-1.0, -2.0], [0], [0], [3.0])))
    builder = DiagramBuilder()
    inside = builder.AddSystem(Formula(rate))
    for name in ("input", "disturbance"):
        builder.ExportInput(inside.GetInputPort(name), name)
    for system in (plant, builder.Build()):
        with pytest.raises(ModelError, match=r"derivative of x\d is .* at x = \[") as e:
            ControlAffineModel.from_system(system)
        message = str(e.value)
        assert "makes of its symbols is" in message
        assert "write (e**2 + c**2)**0.5" in message
        assert "\n" not in message


def test_drag_with_a_rounded_root_is_right() -> None:
    def rounded(t: Any, x: Any, u: Any, d: Any, p: Any) -> list[Any]:
        return [x[1], u[0] + d[0] - (x[1] * x[1] + 1e-12) ** 0.5 * x[1]]

    model = ControlAffineModel.from_system(Formula(rounded))
    np.testing.assert_allclose(model.drift(np.array([0.0, -2.0])), [-2.0, 4.0])


def test_a_plant_whose_values_are_hardly_anywhere_is_said_not_to_be_compared() -> None:
    def far_away(t: Any, x: Any, u: Any, d: Any, p: Any) -> list[Any]:
        return [x[1], u[0] + d[0] - (x[0] - 1e9) ** 0.5]

    with pytest.warns(UserWarning, match=r"x0 is finite at 0 of \d+ points only"):
        ControlAffineModel.from_system(Formula(far_away))


def test_a_plant_is_compared_within_its_effort_limits_and_on_unit_quaternions() -> None:
    plant = MultibodyPlant(time_step=0.0)
    inertia = SpatialInertia(1.3, [0.0, 0.0, 0.0], UnitInertia(0.1, 0.2, 0.25))
    plant.AddRigidBody("free", inertia)
    cart = plant.AddRigidBody("cart", inertia)
    axis = [1.0, 0.0, 0.0]
    rail = PrismaticJoint("rail", plant.world_frame(), cart.body_frame(), axis)
    plant.AddJointActuator("force", plant.AddJoint(rail), 0.5)
    plant.Finalize()
    model = ControlAffineModel.from_system(plant, "actuation")
    assert model.effort_limits.tolist() == [0.5]
    assert sum(name.endswith("_qw") for name in model.state_names) == 1


def test_systems_without_a_symbolic_or_continuous_form_are_refused() -> None:
    class Numeric(LeafSystem):
        def __init__(self) -> None:
            super().__init__()
            self.DeclareContinuousState(1)
            self.DeclareVectorInputPort("input", 1)

    with pytest.raises(ModelError, match=r"Numeric.* does not convert to symbolic"):
        ControlAffineModel.from_system(Numeric())
    with pytest.raises(ModelError, match="discrete"):
        discrete = LinearSystem(A=[[0.0]], B=[[1.0]], C=[[1.0]], time_period=0.1)
        ControlAffineModel.from_system(discrete)
    with pytest.raises(ModelError, match="no continuous state"):
        gain = LinearSystem(A=np.empty((0, 0)), B=np.empty((0, 1)), D=[[1.0]])
        ControlAffineModel.from_system(gain)


def test_ports_that_do_not_fit_are_refused_with_a_list_of_those_there_are() -> None:
    car, builder = Car(), DiagramBuilder()
    builder.AddNamedSystem("integrator", Integrator(1))
    without_inputs = builder.Build()
    there_are = r"its vector input ports are input \(2\), disturbance \(1\)"
    for port in ("throttle", 7, -1, Car().GetInputPort("input")):
        with pytest.raises(ModelError, match=there_are):
            ControlAffineModel.from_system(car, port)
    with pytest.raises(ModelError, match="'input' cannot be both"):
        ControlAffineModel.from_system(car, "input", "input")
    with pytest.raises(
        ModelError, match=r"say which .* estimated_state \(2\), desired"
    ):
        ControlAffineModel.from_system(PidController([1.0], [1.0], [1.0]))
    arm = load(PLANAR)
    assert ControlAffineModel.from_system(arm).num_inputs == 2  # A plant's actuators.
    with pytest.raises(ModelError, match="'applied_spatial_force' carries no vector"):
        ControlAffineModel.from_system(arm, "applied_spatial_force")
    with pytest.raises(ModelError, match="its vector input ports are none"):
        ControlAffineModel.from_system(without_inputs)


def test_states_and_parts_of_wrong_shape_are_refused() -> None:
    model = ControlAffineModel.from_system(Car())
    with pytest.raises(ValueError, match=r"shape \(3,\); it must be \(4,\)"):
        model.drift(np.zeros(3))
    with pytest.raises(ValueError, match=r"must be \(4,\), \(4, m\) and \(4, q\)"):
        ControlAffineModel(
            model.state,
            np.array(model.dynamics.f),
            np.array(model.dynamics.g),
            np.eye(3),
        )
    parallel = np.outer([0.0, 0.0, 1.0, 0.5], [1.0, 2.0])
    f, g = np.array(model.dynamics.f), np.array(model.dynamics.g)
    with pytest.raises(ModelError, match="disturbance matrix E are dependent"):
        ControlAffineModel(model.state, f, g, parallel)


def test_wrapped_states_are_subtracted_the_short_way_round():
    blimp = ControlAffineModel.from_system(Blimp())
    assert np.flatnonzero(np.isfinite(blimp.wrapping_periods)).tolist() == [3]
    before, after = np.zeros(8), np.ones(8)
    before[3], after[3] = 3.1, -3.1
    turned = blimp.difference(np.array([after, before]), before)
    np.testing.assert_allclose(turned[0, 3], 2.0 * np.pi - 6.2)
    np.testing.assert_array_equal(np.delete(turned[0], 3), np.ones(7))
    np.testing.assert_array_equal(turned[1], np.zeros(8))


def test_a_plant_names_its_wrapped_states_in_any_unit():
    plant = PendulumPlant()
    assert np.isinf(ControlAffineModel.from_system(plant).wrapping_periods).all()
    plant.wrapped_states = {"x0": 360.0}
    model = ControlAffineModel.from_system(plant)
    assert model.difference(np.array([1.0, 0.0]), np.array([359.0, 7.0])).tolist() == [
        2.0,
        -7.0,
    ]
    plant.wrapped_states = {"x0": "degrees"}
    with pytest.raises(ModelError, match=r"period 'degrees'; it must be .* above 0"):
        ControlAffineModel.from_system(plant)
    plant.wrapped_states = ["theta"]
    with pytest.raises(ModelError, match=r"has 'theta'.*one of x0, x1"):
        ControlAffineModel.from_system(plant)


def test_a_diagram_says_what_the_system_in_it_says():
    builder = DiagramBuilder()
    car = builder.AddNamedSystem("car", Car())
    lag = builder.AddNamedSystem("lag", FirstOrderLowPassFilter([0.1, 0.1]))
    builder.Connect(lag.get_output_port(), car.GetInputPort("input"))
    builder.ExportInput(lag.get_input_port(), "input")
    builder.ExportInput(car.GetInputPort("disturbance"), "disturbance")
    diagram = builder.Build()
    model = ControlAffineModel.from_system(diagram)
    heading = model.state_names.index("car_heading")
    periods = model.wrapping_periods
    assert periods[heading] == 2.0 * np.pi and np.isfinite(periods).sum() == 1
    assert model.position == (0, 1)
    # Where Drake itself keeps the heading.
    context = diagram.CreateDefaultContext()
    mine = car.GetMyMutableContextFromRoot(context)
    mine.SetContinuousState([0.0, 0.0, 0.0, 0.5])
    assert context.get_continuous_state_vector()[heading] == 0.5


def test_a_plant_without_a_name_has_its_class_s_in_messages():
    assert ControlAffineModel.from_system(Car()).name == "Car"
    assert ControlAffineModel.from_system(LinearSystem(*np.ones((3, 1, 1)))).name == (
        "LinearSystem"
    )
