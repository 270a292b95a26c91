from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed
import pytest

from vcbf_drake.checks import Array
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.model.graph import variables_of
from vcbf_drake.plants import Blimp, BlimpParameters

UNEQUAL = BlimpParameters(
    mass=0.2,
    added_mass=[0.03, 0.15, 0.1],
    drag=[0.02, 0.07, 0.05],
    yaw_inertia=0.01,
    yaw_drag=0.003,
)


def state_rate(
    blimp: Any, x: Array, u: Array, d: Array | None = None, context: Any = None
) -> Array:
    context = context or blimp.CreateDefaultContext()
    context.SetContinuousState(x)
    blimp.GetInputPort("input").FixValue(context, u)
    if d is not None:
        blimp.GetInputPort("disturbance").FixValue(context, d)
    rate: Array = blimp.EvalTimeDerivatives(context).CopyToVector()
    return rate


def body_velocity(x: Array) -> Array:
    c, s = np.cos(x[3]), np.sin(x[3])
    return np.array([[c, s], [-s, c]]) @ x[4:6]


def test_closed_form_of_a_blimp_with_equal_surge_and_sway() -> None:
    # (E76), with the numbers of the GT-MAB written out.
    m_x, m_z, inertia = 0.1715, 0.1794, 0.005821
    random = np.random.default_rng(0)
    for _ in range(20):
        x, u, d = random.normal(size=8), random.normal(size=3), random.normal(size=3)
        acceleration = (
            np.array([np.cos(x[3]), np.sin(x[3]), 0.0]) * u[0] / m_x
            + np.array([0.0, 0.0, u[1] / m_z])
            - np.array([0.0125 / m_x, 0.0125 / m_x, 0.0480 / m_z]) * x[4:7]
            + d
        )
        expected = [*x[4:], *acceleration, (u[2] - 0.000862 * x[7]) / inertia]
        np.testing.assert_allclose(state_rate(Blimp(), x, u, d), expected, rtol=1e-12)


def test_closed_form_of_a_blimp_with_unequal_surge_and_sway() -> None:
    # Kirchhoff's equations in body axes, turned into inertial ones by hand.
    m_x, m_y, m_z = UNEQUAL.effective_masses
    random = np.random.default_rng(1)
    for _ in range(20):
        x, force = random.normal(size=8), random.normal(size=3)
        (u, w), r = body_velocity(x), x[7]
        du = (force[0] + m_y * r * w - 0.02 * u) / m_x
        dw = (-m_x * r * u - 0.07 * w) / m_y
        c, s = np.cos(x[3]), np.sin(x[3])
        # d/dt of R [u; w] = R [du - r w; dw + r u].
        ax, ay = np.array([[c, -s], [s, c]]) @ [du - r * w, dw + r * u]
        az = (force[1] - 0.05 * x[6]) / m_z
        dr = (force[2] + (m_x - m_y) * u * w - 0.003 * r) / 0.01
        expected = [*x[4:], ax, ay, az, dr]
        rate = state_rate(Blimp(UNEQUAL), x, force)
        np.testing.assert_allclose(rate, expected, rtol=1e-12, atol=1e-12)


def test_energy_and_momentum_are_conserved_without_drag_and_input() -> None:
    parameters = BlimpParameters(
        added_mass=[0.03, 0.15, 0.1], drag=[0.0, 0.0, 0.0], yaw_drag=0.0
    )
    masses = np.array(parameters.effective_masses)
    blimp = Blimp(parameters)

    def energy(x: Array) -> float:
        velocity = np.array([*body_velocity(x), x[6]])
        kinetic = masses @ velocity**2 + parameters.yaw_inertia * x[7] ** 2
        return float(kinetic) / 2.0

    def momentum(x: Array) -> Array:
        c, s = np.cos(x[3]), np.sin(x[3])
        linear: Array = np.array([[c, -s], [s, c]]) @ (masses[:2] * body_velocity(x))
        return linear

    random = np.random.default_rng(2)
    for _ in range(20):
        x = random.normal(size=8)
        step = 1e-5 * state_rate(blimp, x, np.zeros(3))
        assert energy(x + step) == pytest.approx(energy(x - step), abs=1e-11)
        change = momentum(x + step) - momentum(x - step)
        np.testing.assert_allclose(change, 0.0, atol=1e-11)


def test_no_disturbance_is_a_disturbance_of_zero() -> None:
    x, u = np.arange(8.0), np.ones(3)
    np.testing.assert_array_equal(
        state_rate(Blimp(), x, u), state_rate(Blimp(), x, u, np.zeros(3))
    )


def test_equal_surge_and_sway_leave_no_trace_of_yaw_in_the_acceleration() -> None:
    # The filter relies on it: the yaw moment's column in the rows is exactly 0.
    model = ControlAffineModel.from_system(Blimp())
    _, _, _, yaw, *_, yaw_rate = model.dynamics.x
    assert variables_of(model.dynamics.f[4:7]).isdisjoint({yaw, yaw_rate})
    unequal = ControlAffineModel.from_system(Blimp(UNEQUAL))
    assert yaw_rate in variables_of([unequal.dynamics.f[4]])


@pytest.mark.parametrize("convert", ["ToAutoDiffXd", "ToSymbolic"])
def test_parameters_of_the_context_survive_scalar_conversion(convert: str) -> None:
    blimp = Blimp()
    context = blimp.CreateDefaultContext()
    context.get_mutable_numeric_parameter(0).SetFromVector(UNEQUAL.to_vector())
    x, u = np.linspace(-1.0, 1.0, 8), np.array([1.0, 2.0, 3.0])
    expected = state_rate(Blimp(UNEQUAL), x, u)
    np.testing.assert_array_equal(state_rate(blimp, x, u, context=context), expected)
    converted = getattr(blimp, convert)()
    target = converted.CreateDefaultContext()
    target.SetTimeStateAndParametersFrom(context)
    converted.GetInputPort("input").FixValue(target, u)
    rate = converted.EvalTimeDerivatives(target).CopyToVector()
    value = {"ToAutoDiffXd": "value", "ToSymbolic": "Evaluate"}[convert]
    np.testing.assert_allclose([getattr(r, value)() for r in rate], expected)


def test_construction_parameters_survive_scalar_conversion_and_later_changes() -> None:
    parameters = BlimpParameters(mass=0.5)
    blimp = Blimp(parameters)
    parameters.added_mass[0] = 9.0
    parameters.mass = 9.0
    for system in (blimp, blimp.ToAutoDiffXd().ToSymbolic()):
        vector = system.CreateDefaultContext().get_numeric_parameter(0).CopyToVector()
        assert [float(str(v)) for v in vector[:2]] == [0.5, 0.0466]


def test_names_match_the_state_and_input() -> None:
    rates = ("vx", "vy", "vz", "yaw_rate")
    assert Blimp.state_names == ("x", "y", "z", "yaw", *rates)
    assert Blimp.input_names == ("surge_force", "heave_force", "yaw_moment")
    assert len(Blimp.state_units) == 8
    assert len(Blimp.input_units) == 3
    names = [Blimp.state_names[i] for i in Blimp.position_indices]
    assert names == ["x", "y", "z"]
    blimp = Blimp()
    assert blimp.GetInputPort("input").size() == 3
    assert blimp.GetInputPort("disturbance").size() == 3
    assert blimp.GetOutputPort("state").size() == 8


def test_parameters_load_from_yaml() -> None:
    text = "{mass: 0.3, drag: [0.1, 0.2, 0.3]}"
    loaded = yaml_load_typed(schema=BlimpParameters, data=text)
    assert loaded == BlimpParameters(mass=0.3, drag=[0.1, 0.2, 0.3])
    again = yaml_load_typed(schema=BlimpParameters, data=yaml_dump_typed(loaded))
    assert again == loaded


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass": 0.0}, "mass: 0; it must be finite and above 0"),
        ({"mass": float("inf")}, "mass: inf"),
        ({"yaw_inertia": -1.0}, "yaw_inertia: -1"),
        ({"yaw_drag": -1e-9}, "yaw_drag: -1e-09; .* finite and not below 0"),
        ({"drag": [0.0, 0.0, float("nan")]}, r"drag\[2\]: nan; .* finite"),
        ({"added_mass": [0.1, 0.1]}, "added_mass: "),
        ({"added_mass": 0.1}, "added_mass: 0.1"),
        ({"mass": "heavy"}, "mass: 'heavy'"),
    ],
)
def test_parameters_without_physical_meaning_are_refused(
    change: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Blimp(BlimpParameters(**change))
