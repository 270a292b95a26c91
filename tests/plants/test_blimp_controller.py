from __future__ import annotations

from dataclasses import replace
import math
from typing import Any

import numpy as np
from pydrake.common.yaml import yaml_load_typed
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, ZeroOrderHold
import pytest

from vcbf_drake.checks import Array
from vcbf_drake.plants import (
    Blimp,
    BlimpController,
    BlimpControllerParameters,
    BlimpParameters,
)

TARGET = np.array([14.0, 3.0, 2.5])
LITERAL = BlimpControllerParameters()
LEANING = BlimpControllerParameters(drift_gain=2.0)


def reference(
    controller: BlimpController, state: Any, estimate: Any | None = None
) -> Array:
    context = controller.CreateDefaultContext()
    controller.GetInputPort("state").FixValue(context, np.asarray(state, dtype=float))
    if estimate is not None:
        controller.GetInputPort("disturbance_estimate").FixValue(context, estimate)
    value: Array = controller.GetOutputPort("reference").Eval(context)
    return value


def literal_law(x: Array, target: Array, p: BlimpControllerParameters) -> Array:
    """The law (E81) by its formulas, with signed surge and yaw damping."""
    e_d = np.linalg.norm(x[:2] - target[:2])
    e_yaw = x[3] - np.angle(complex(*(target - x[:3])[:2]))
    e_yaw = np.angle(np.exp(1j * e_yaw))
    u_s = x[4] * np.cos(x[3]) + x[5] * np.sin(x[3])
    surge_speed = min(p.position_gain * e_d, p.surge_speed_cap) * np.cos(e_yaw)
    e_z = np.clip(x[2] - target[2], -p.height_error_cap, p.height_error_cap)
    return np.array(
        [
            -p.surge_gain * (u_s - surge_speed),
            -p.heave_gain * (x[6] + p.height_gain * e_z),
            -p.yaw_gain * e_yaw - p.yaw_rate_gain * x[7],
        ]
    )


@pytest.mark.parametrize("caps", [(math.inf, math.inf), (0.6, 0.3)])
def test_without_drift_gain_it_is_the_published_law(
    caps: tuple[float, float],
) -> None:
    parameters = BlimpControllerParameters(1.0, 0.4, 0.7, 0.6, 0.05, 0.03, 0.0, *caps)
    controller = BlimpController(TARGET, parameters)
    random = np.random.default_rng(0)
    for _ in range(50):
        state = random.normal(scale=3.0, size=8)
        expected = literal_law(state, TARGET, parameters)
        np.testing.assert_allclose(reference(controller, state), expected, atol=1e-12)


def test_at_the_target_and_at_rest_it_asks_for_nothing() -> None:
    state = [*TARGET, 0.7, 0.0, 0.0, 0.0, 0.0]
    np.testing.assert_array_equal(reference(BlimpController(TARGET), state), 0.0)


def test_the_estimate_is_compensated_where_there_is_a_force_for_it() -> None:
    plant = BlimpParameters(mass=0.3, added_mass=[0.1, 0.5, 0.2])
    controller = BlimpController(TARGET, plant_parameters=plant)
    yaw = 0.4
    state = [1.0, 2.0, 3.0, yaw, 0.1, 0.2, 0.3, 0.4]
    estimate = np.array([0.5, -0.2, 0.3])
    ahead = 0.5 * math.cos(yaw) - 0.2 * math.sin(yaw)
    np.testing.assert_allclose(
        reference(controller, state, estimate) - reference(controller, state),
        [-0.4 * ahead, -0.5 * 0.3, 0.0],
        rtol=1e-12,
    )


def test_the_heading_is_left_alone_near_the_target() -> None:
    for offset, turns in ((0.04, False), (0.06, True)):
        state = [TARGET[0] + offset, *TARGET[1:], 0.3, 0.0, 0.0, 0.0, 0.0]
        _, _, moment = reference(BlimpController(TARGET), state)
        assert (moment != 0.0) == turns


def test_a_target_behind_turns_the_short_way_and_backs_up() -> None:
    controller = BlimpController([-5.0, 0.0, 0.0], LITERAL)
    for yaw, sign in ((0.1, 1.0), (-0.1, -1.0), (0.1 + 2.0 * math.pi, 1.0)):
        force, _, moment = reference(controller, [0, 0, 0, yaw, 0, 0, 0, 0])
        assert moment * sign > 0.0
        assert force < 0.0


def test_the_heading_leans_against_sideways_drift() -> None:
    controller = BlimpController([10.0, 0.0, 0.0], LEANING)
    drifting_left = [0, 0, 0, 0, 0.0, 0.5, 0, 0]
    assert reference(controller, drifting_left)[2] < 0.0
    # Along the line of sight the drift gain changes nothing.
    straight = [0, 0, 0, 0.2, 0.7, 0.0, 0, 0]
    np.testing.assert_allclose(
        reference(controller, straight),
        reference(BlimpController([10.0, 0.0, 0.0], LITERAL), straight),
    )


def fly(
    target: Any,
    initial_state: Any,
    parameters: BlimpControllerParameters | None = None,
    disturbance: Any = (0.0, 0.0, 0.0),
    duration: float = 30.0,
) -> Array:
    """Distances to the target [m] at each control period of 0.02 s."""
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", Blimp())
    controller = builder.AddNamedSystem(
        "controller", BlimpController(target, parameters)
    )
    hold = builder.AddNamedSystem("hold", ZeroOrderHold(0.02, 3))
    state = plant.GetOutputPort("state")
    builder.Connect(state, controller.GetInputPort("state"))
    builder.Connect(controller.GetOutputPort("reference"), hold.get_input_port())
    builder.Connect(hold.get_output_port(), plant.GetInputPort("input"))
    log = LogVectorOutput(state, builder, 0.02)
    simulator = Simulator(builder.Build())
    config = SimulatorConfig(
        integration_scheme="runge_kutta2", max_step_size=0.02, use_error_control=False
    )
    ApplySimulatorConfig(config, simulator)
    context = simulator.get_mutable_context()
    context.SetContinuousState(initial_state)
    for system, port in ((plant, "disturbance"), (controller, "disturbance_estimate")):
        own = system.GetMyContextFromRoot(context)
        system.GetInputPort(port).FixValue(own, disturbance)
    simulator.AdvanceTo(duration)
    offset = log.FindLog(context).data()[:3].T - np.asarray(target)
    return np.asarray(np.linalg.norm(offset, axis=1))


def test_flies_straight_to_a_far_target_and_stays() -> None:
    caps = replace(LEANING, surge_speed_cap=1.88, height_error_cap=0.79)
    start = [0, 0, 0, math.atan2(3.0, 14.0), 0, 0, 0, 0]
    distance = fly(TARGET, start, caps, duration=25.0)
    assert distance[-1] < 0.01
    arrived = np.argmax(distance < 0.3) * 0.02
    assert arrived < 20.0
    assert distance[distance.argmin() :].max() < 0.3


@pytest.mark.parametrize(
    ("target", "yaw", "disturbance"),
    [
        ([1.0, 0.0, 1.0], 1.5, [0.0, 0.0, 0.0]),
        ([-3.0, 1.0, 1.0], 0.3, [0.0, 0.0, 0.0]),
        ([5.0, 1.0, 0.5], 0.0, [0.03, -0.03, 0.05]),
    ],
)
def test_turns_to_a_target_aside_and_stays_near_it(
    target: list[float], yaw: float, disturbance: list[float]
) -> None:
    distance = fly(target, [0, 0, 0, yaw, 0, 0, 0, 0], LEANING, disturbance)
    assert distance[-500:].max() < 0.3


def test_parameters_load_from_yaml_and_are_checked() -> None:
    loaded = yaml_load_typed(
        schema=BlimpControllerParameters,
        data="{surge_gain: 0.8, surge_speed_cap: .inf, height_error_cap: 0.5}",
    )
    assert loaded == BlimpControllerParameters(surge_gain=0.8, height_error_cap=0.5)
    for change, message in [
        ({"surge_gain": -0.1}, "surge_gain: -0.1; .* finite and not below 0"),
        ({"yaw_gain": math.inf}, "yaw_gain: inf"),
        ({"surge_speed_cap": 0.0}, "surge_speed_cap: 0; .* above 0"),
        ({"height_error_cap": math.nan}, "height_error_cap: nan"),
    ]:
        with pytest.raises(ValueError, match=message):
            BlimpController(TARGET, BlimpControllerParameters(**change))
    for target in ([1.0, 2.0], [1.0, 2.0, math.nan]):
        with pytest.raises(ValueError, match="it must be 3 finite numbers"):
            BlimpController(target)
