from __future__ import annotations

import numpy as np
from pydrake.common.yaml import yaml_load_typed
from pydrake.systems.primitives import Linearize
import pytest

from vcbf_drake.checks import Array
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Car, CarParameters


def test_closed_form() -> None:
    # (E79)
    random = np.random.default_rng(0)
    car = Car(CarParameters(mass=1.6))
    context = car.CreateDefaultContext()
    for _ in range(20):
        x, u, d = random.normal(size=4), random.normal(size=2), random.normal(size=1)
        context.SetContinuousState(x)
        car.GetInputPort("input").FixValue(context, u)
        car.GetInputPort("disturbance").FixValue(context, d)
        _, _, speed, heading = x
        expected = [
            speed * np.cos(heading),
            speed * np.sin(heading),
            u[0] / 1.6 + d[0],
            u[1],
        ]
        rate = car.EvalTimeDerivatives(context).CopyToVector()
        np.testing.assert_allclose(rate, expected, rtol=1e-12)


def test_no_disturbance_is_a_disturbance_of_zero() -> None:
    car = Car()
    context = car.CreateDefaultContext()
    context.SetContinuousState([1.0, 2.0, 3.0, 0.0])
    car.GetInputPort("input").FixValue(context, [4.0, 5.0])
    rate = car.EvalTimeDerivatives(context).CopyToVector()
    np.testing.assert_array_equal(rate, [3.0, 0.0, 2.0, 5.0])


def test_mass_comes_from_the_context_and_survives_scalar_conversion() -> None:
    car = Car(CarParameters(mass=0.5))
    context = car.CreateDefaultContext()
    car.GetInputPort("input").FixValue(context, [1.0, 0.0])
    assert car.EvalTimeDerivatives(context).CopyToVector()[2] == 2.0
    context.get_mutable_numeric_parameter(0).SetFromVector([4.0])
    assert car.EvalTimeDerivatives(context).CopyToVector()[2] == 0.25
    model = ControlAffineModel.from_system(car, context=context)
    assert model.input_matrix(np.zeros(4))[2, 0] == 0.25
    np.testing.assert_array_equal(model.disturbance_matrix, [[0], [0], [1], [0]])
    symbolic = car.ToAutoDiffXd().ToSymbolic()
    parameter = symbolic.CreateDefaultContext().get_numeric_parameter(0).GetAtIndex(0)
    assert parameter.Evaluate() == 0.5


def test_linearization() -> None:
    car = Car()
    context = car.CreateDefaultContext()
    v, psi = 1.5, 0.4
    context.SetContinuousState([0.0, 0.0, v, psi])
    car.GetInputPort("input").FixValue(context, [0.0, 0.0])
    port = car.GetInputPort("input").get_index()
    linear = Linearize(car, context, port, equilibrium_check_tolerance=np.inf)
    A: Array = np.zeros((4, 4))
    A[0, 2:] = np.cos(psi), -v * np.sin(psi)
    A[1, 2:] = np.sin(psi), v * np.cos(psi)
    np.testing.assert_allclose(linear.A(), A, atol=1e-14)
    np.testing.assert_allclose(linear.B(), [[0, 0], [0, 0], [0.5, 0], [0, 1]])


def test_names_match_the_state_and_input() -> None:
    assert Car.state_names == ("x", "y", "speed", "heading")
    assert Car.input_names == ("acceleration_force", "turn_rate")
    assert (len(Car.state_units), len(Car.input_units)) == (4, 2)
    assert [Car.state_names[i] for i in Car.position_indices] == ["x", "y"]


def test_parameters_load_from_yaml_and_are_checked() -> None:
    assert yaml_load_typed(schema=CarParameters, data="{mass: 3}").mass == 3.0
    for mass in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=r"mass: .* above 0"):
            Car(CarParameters(mass=mass))
