from __future__ import annotations

import math
from typing import Any

import numpy as np
from pydrake.common.yaml import yaml_load_typed
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
import pytest

from vcbf_drake.checks import Array
from vcbf_drake.plants import Car, CarController, CarControllerParameters, CarParameters

TARGET = np.array([5.0, 0.0])


def reference(
    controller: CarController, state: Any, estimate: Any | None = None
) -> Array:
    context = controller.CreateDefaultContext()
    controller.GetInputPort("state").FixValue(context, np.asarray(state, dtype=float))
    if estimate is not None:
        controller.GetInputPort("disturbance_estimate").FixValue(context, estimate)
    value: Array = controller.GetOutputPort("reference").Eval(context)
    return value


def test_it_is_the_published_law() -> None:
    # (E82), the heading error by way of complex numbers.
    parameters = CarControllerParameters(1.7, 3.0, 0.4)
    controller = CarController(TARGET, parameters, CarParameters(mass=1.5))
    random = np.random.default_rng(0)
    for _ in range(50):
        x, y, speed, heading = state = random.normal(scale=3.0, size=4)
        (estimate,) = random.normal(size=1)
        offset = complex(TARGET[0] - x, TARGET[1] - y)
        error = np.angle(np.exp(1j * heading) / offset)
        wanted = 0.4 * abs(offset) * np.cos(error)
        np.testing.assert_allclose(
            reference(controller, state, [estimate]),
            [-3.0 * (speed - wanted) - 1.5 * estimate, -1.7 * error],
            atol=1e-12,
        )
        force, turn_rate = reference(controller, state)
        assert force == pytest.approx(-3.0 * (speed - wanted))
        assert turn_rate == pytest.approx(-1.7 * error)


def test_the_heading_is_left_alone_near_the_target() -> None:
    for offset, turns in ((0.04, False), (0.06, True)):
        _, turn_rate = reference(CarController(TARGET), [5.0, offset, 0.0, 0.0])
        assert (turn_rate != 0.0) == turns


@pytest.mark.parametrize("target", [[5.0, 0.0], [-2.0, 3.0], [-4.0, -0.5]])
def test_drives_to_the_target_and_stops(target: list[float]) -> None:
    disturbance = [0.3]
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", Car())
    controller = builder.AddNamedSystem("controller", CarController(target))
    builder.Connect(plant.GetOutputPort("state"), controller.GetInputPort("state"))
    builder.Connect(controller.GetOutputPort("reference"), plant.GetInputPort("input"))
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    for system, port in ((plant, "disturbance"), (controller, "disturbance_estimate")):
        own = system.GetMyContextFromRoot(context)
        system.GetInputPort(port).FixValue(own, disturbance)
    simulator.get_mutable_integrator().set_target_accuracy(1e-3)
    simulator.AdvanceTo(20.0)
    x, y, speed, _ = context.get_continuous_state_vector().CopyToVector()
    assert math.hypot(x - target[0], y - target[1]) < 0.1
    assert abs(speed) < 0.05


def test_parameters_load_from_yaml_and_are_checked() -> None:
    loaded = yaml_load_typed(schema=CarControllerParameters, data="{approach_gain: 1}")
    assert loaded == CarControllerParameters(approach_gain=1.0)
    for name in ("turn_gain", "speed_gain", "approach_gain"):
        with pytest.raises(ValueError, match=f"{name}: -1"):
            CarControllerParameters(**{name: -1.0})
    for target in ([1.0, 2.0, 3.0], [1.0, math.inf]):
        with pytest.raises(ValueError, match="it must be 2 finite numbers"):
            CarController(target)
