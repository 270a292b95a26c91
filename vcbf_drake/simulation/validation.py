"""validate: what the types of a scenario's fields cannot say."""

from __future__ import annotations

from collections.abc import Collection, Sequence
import math
import re
from typing import NamedTuple

from pydrake.systems.analysis import GetIntegrationSchemes

from vcbf_drake.plants.blimp import BlimpParameters
from vcbf_drake.plants.blimp_controller import BlimpControllerParameters
from vcbf_drake.plants.car import CarParameters
from vcbf_drake.plants.car_controller import CarControllerParameters
from vcbf_drake.simulation.invalid_field import (
    InvalidFieldError,
    KeyPath,
    ask,
    require,
)
from vcbf_drake.simulation.scenario import (
    InputLimits,
    Obstacle,
    Scenario,
)
from vcbf_drake.simulation.scenario_numbers import check_magnitudes, check_numbers

BARRIER_FORMS = ("distance", "squared")
FALLBACKS = ("zero", "brake")


class PlantKind(NamedTuple):
    """What a scenario has to know about a plant: its controller and its sizes."""

    name: str
    controller: type
    states: int
    inputs: int
    disturbances: int
    dimensions: int


PLANT_KINDS = {
    BlimpParameters: PlantKind("blimp", BlimpControllerParameters, 8, 3, 3, 3),
    CarParameters: PlantKind("car", CarControllerParameters, 4, 2, 1, 2),
}


def validate(scenario: Scenario) -> None:
    """Checks what types cannot say: signs, sizes, choices, and that parts agree.

    Raises:
        InvalidFieldError: A `ScenarioError` that names the field, its value and what
            is allowed.
    """
    _check_name(scenario.name)
    check_magnitudes(scenario)
    check_numbers(scenario)
    ask(scenario.observer.__post_init__, scenario.observer, ("observer",))
    ask(scenario.check, scenario, ())
    _check_choices(scenario)
    _check_sizes(scenario)
    _check_input_set(scenario.input_set)
    _check_disturbance(scenario)
    _check_gains(scenario.barrier.gains)
    _check_threshold(scenario.volume.threshold)
    _check_period(scenario)
    _check_geometry(scenario)


def _check_name(name: str) -> None:
    """Results are written into a directory of that name."""
    allowed = not name or (_NAME.fullmatch(name) is not None and len(name) <= 100)
    rule = "at most 100 letters, digits, spaces and _ . + -, a letter or digit first"
    require(allowed, ("name",), name, rule)


_NAME = re.compile(r"\w[\w .+-]*")


# Choices ---------------------------------------------------------------------------


def _check_choices(scenario: Scenario) -> None:
    choices: list[tuple[KeyPath, str, Collection[str]]] = [
        (("barrier", "form"), scenario.barrier.form, BARRIER_FORMS),
        (("hardware", "fallback"), scenario.hardware.fallback, FALLBACKS),
        (
            ("integrator", "scheme"),
            scenario.integrator.scheme,
            GetIntegrationSchemes(),
        ),
    ]
    for path, value, allowed in choices:
        require(value in allowed, path, value, f"one of {', '.join(allowed)}")
    _check_pairing(scenario, PLANT_KINDS[type(scenario.plant)])


def _check_pairing(scenario: Scenario, kind: PlantKind) -> None:
    if not isinstance(scenario.controller, kind.controller):
        raise InvalidFieldError(
            ("controller",),
            f"!{type(scenario.controller).__name__}; it must be"
            f" !{kind.controller.__name__}, for the plant is a {kind.name}",
        )
    if scenario.turn_limit is not None and kind.name != "car":
        raise InvalidFieldError(
            ("turn_limit",),
            f"given; it must be left out, for the plant is a {kind.name}",
        )


# Sizes -----------------------------------------------------------------------------


def _check_sizes(scenario: Scenario) -> None:
    kind, limits = PLANT_KINDS[type(scenario.plant)], scenario.input_set
    _check_size(("initial_state",), scenario.initial_state, kind.states, "state")
    _check_size(("target",), scenario.target, kind.dimensions, "dimension")
    _check_size(("input_set", "lower"), limits.lower, kind.inputs, "input")
    _check_size(("input_set", "upper"), limits.upper, kind.inputs, "input")
    _check_size(("input_set", "b"), limits.b, len(limits.A), "row of A")
    for index, row in enumerate(limits.A):
        _check_size(("input_set", "A", index), row, kind.inputs, "input")
    _check_size(("barrier", "gains"), scenario.barrier.gains, 2, "relative degree")
    _check_fault_sizes(scenario, kind)
    if len(scenario.noise.std):
        _check_size(("noise", "std"), scenario.noise.std, kind.states, "state")
    for index, obstacle in enumerate(scenario.obstacles):
        path: KeyPath = ("obstacles", index)
        _check_size((*path, "center"), obstacle.center, kind.dimensions, "dimension")
        if len(obstacle.velocity):
            _check_size(
                (*path, "velocity"), obstacle.velocity, kind.dimensions, "dimension"
            )


def _check_fault_sizes(scenario: Scenario, kind: PlantKind) -> None:
    faults, path = scenario.faults, "faults"
    if len(faults.measurement_bias):
        _check_size(
            (path, "measurement_bias"), faults.measurement_bias, kind.states, "state"
        )
    require(
        faults.measurement_delay <= scenario.duration,
        (path, "measurement_delay"),
        faults.measurement_delay,
        f"at most the duration, {scenario.duration:g} s",
    )
    for index, gust in enumerate(faults.gusts):
        _check_size(
            (path, "gusts", index, "amplitude"),
            gust.amplitude,
            kind.disturbances,
            "disturbed state",
        )
    if kind.name == "car":
        require(
            faults.drag == 1.0, (path, "drag"), faults.drag, "1, for a car has no drag"
        )


def _check_size(path: KeyPath, value: Sequence[float], size: int, of: str) -> None:
    count = f"{size} number{'s' * (size != 1)}"
    require(len(value) == size, path, list(value), f"{count}, one per {of}")


# Parts that must agree -------------------------------------------------------------


def _check_input_set(limits: InputLimits) -> None:
    for index, lower in enumerate(limits.lower):
        upper = limits.upper[index]
        path: KeyPath = ("input_set", "lower", index)
        require(lower < upper, path, lower, f"below upper, {upper:g}")
    ask(limits.input_set, limits, ("input_set",))


def _check_disturbance(scenario: Scenario) -> None:
    size = PLANT_KINDS[type(scenario.plant)].disturbances
    for index, signal in enumerate(scenario.disturbance):
        path: KeyPath = ("disturbance", index)
        curve = ask(lambda s=signal: s.curve(scenario.duration), signal, path)  # type: ignore[misc]
        if curve.size != size:
            raise InvalidFieldError(
                path,
                f"has {curve.size} channels; it must have {size},"
                " one per disturbed state",
            )


def _check_gains(gains: Sequence[float]) -> None:
    k1, k2 = gains
    require(
        k1 * k1 >= 4.0 * k2,
        ("barrier", "gains"),
        list(gains),
        "(k1, k2) with real roots of s^2 + k1 s + k2, so k1^2 >= 4 k2",
    )


def _check_threshold(threshold: float) -> None:
    path = ("volume", "threshold")
    require(threshold < 1.0, path, threshold, "below 1, det B of the free box")


# Control periods in a run; its log must fit into a computer.
_MOST_TICKS = 1e7


def _check_period(scenario: Scenario) -> None:
    require(
        scenario.period <= scenario.duration,
        ("period",),
        scenario.period,
        f"at most the duration, {scenario.duration:g} s",
    )
    least = scenario.duration / _MOST_TICKS
    require(
        scenario.period >= least,
        ("period",),
        scenario.period,
        f"at least {least:g} s, for {_MOST_TICKS:g} ticks",
    )


def _check_geometry(scenario: Scenario) -> None:
    start = scenario.initial_state[: len(scenario.target)]
    for index, obstacle in enumerate(scenario.obstacles):
        _check_outside(("initial_state",), start, index, obstacle)
        if not any(obstacle.velocity):
            _check_outside(("target",), scenario.target, index, obstacle)


def _check_outside(
    path: KeyPath, position: Sequence[float], index: int, obstacle: Obstacle
) -> None:
    distance = math.dist(position, obstacle.center) - obstacle.radius - obstacle.margin
    require(
        distance > 0.0,
        path,
        list(position),
        f"outside obstacles[{index}], margin included; its signed distance is"
        f" {distance:.3g} m",
    )
