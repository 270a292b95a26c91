"""The contract of a vehicle: what is returned instead is named, in one line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
import math
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydrake.geometry import Box, Mesh
from pydrake.systems.primitives import Gain, LinearSystem
import pytest

from vcbf_drake import InputLimits, Scenario, load_scenario, simulate
from vcbf_drake.barriers import StateLimit
from vcbf_drake.errors import InvalidValueError, ScenarioError
from vcbf_drake.plants import CarVehicle, Part, StateFeedback, Vehicle
from vcbf_drake.simulation import check_assumptions, dump_scenario
from vcbf_drake.simulation.loading import parse_scenario


def integrators(*names: str) -> Any:
    """A plant of two integrators: its velocities are its inputs."""
    zeros, one = np.zeros((2, 2)), np.eye(2)
    plant: Any = LinearSystem(zeros, one, one, zeros)
    plant.state_names = names
    return plant


@dataclass
class Trolley(Vehicle):
    """A point that goes where it is told."""

    gain: float = 1.0
    sides: tuple[float, float] = (0.2, 0.1)
    marks: tuple[int, ...] = ()
    position = (0, 1)

    def make_plant(self) -> Any:
        return integrators("x", "y")

    def make_controller(self, target: Any) -> Any:
        return StateFeedback(lambda x: self.gain * (target - x), 2, 2)

    def barriers(self) -> Any:
        return StateLimit(1, -1.0, 1.0).barriers([2.0])

    def geometry(self, color: str) -> list[Part]:
        return [Part("box", Box(*self.sides, 0.1), color)]


@dataclass
class LongTrolley(Trolley):
    """A vehicle that is derived from another one."""

    length_of_bed: float = 2.0


@dataclass
class HeavyTrolley(Trolley):
    """A vehicle that its own parameters can make impossible."""

    mass: float = 1.0
    inertia: float = 1.0
    drag: float = 0.0

    def make_plant(self) -> Any:
        zeros, one = np.zeros((2, 2)), np.eye(2)
        with np.errstate(all="ignore"):
            return LinearSystem(zeros, one / np.float64(self.inertia), one, zeros)


@dataclass
class Led(Trolley):
    """One whose law returns the same, whatever that is."""

    RETURNED: ClassVar[Any]

    def make_controller(self, target: Any) -> StateFeedback:
        return StateFeedback(lambda x: self.RETURNED, 2, 2)


def led(returned: Any) -> Led:
    Led.RETURNED = returned
    return Led()


def scenario_with(vehicle: Vehicle) -> Scenario:
    return Scenario(
        name="trolley",
        vehicle=vehicle,
        method="cbf-qp",
        input_set=InputLimits([-1.0, -1.0], [1.0, 1.0]),
        initial_state=[0.0, 0.0],
        target=[2.0, 0.0],
        duration=0.1,
    )


def refusal(vehicle: Vehicle) -> str:
    with pytest.raises(InvalidValueError) as caught:
        scenario_with(vehicle)
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("member", "wrong", "message"),
    [
        ("make_plant", lambda self: None, "make_plant(): None; it must be a Drake"),
        (
            "make_plant",
            lambda self: integrators("x"),
            "make_plant().state_names: ('x',)",
        ),
        (
            "make_plant",
            lambda self: integrators("x", "x"),
            "2 different texts, or none",
        ),
        ("position", None, "position: None; it must be 1 to 3 different indices"),
        ("position", (0, 2), "position: (0, 2); it must be 1 to 3 different indices"),
        ("position", (0, 0), "whole numbers from 0 to 1, or a function of the state"),
        ("position", ("x", "y"), "position: ('x', 'y'); it must be"),
        ("position", lambda self, x: x[0], "position(state): 0"),
        ("position", lambda self, x: None, "position(state): None; it must be 1 to 3"),
        ("heading", 2, "heading: 2; it must be None, or one of the indices"),
        ("heading", "yaw", "heading: 'yaw'; it must be None, or one of the indices"),
        ("make_controller", lambda self, target: None, "(target): None; it must be a"),
        (
            "make_controller",
            lambda self, target: Gain(1.0, 2),
            "input ports: {'u0': 2}; it must be a system with input port state",
        ),
        (
            "make_controller",
            lambda self, target: StateFeedback(np.sum, 2, 1),
            "output ports: {'reference': 1}; it must be a system with output port",
        ),
        ("barriers", lambda self: None, "barriers(): None; it must be a list"),
        ("barriers", lambda self: [StateLimit(1, 0.0)], "barriers()[0]: StateLimit("),
        ("pose", lambda self, state: None, "pose(state): None; it must be a RigidTr"),
        ("poses", lambda self, state: [], "poses(state): []; it must be a dict"),
        ("geometry", lambda self, color: None, "geometry(color): None; it must be a"),
        ("geometry", lambda self, color: [Box(1, 1, 1)], "geometry(color)[0]: Box("),
        (
            "geometry",
            lambda self, color: [Part("box", Box(1, 1, 1), "red")],
            "geometry(color)[0].color: 'red'; it must be hexadecimal",
        ),
        (
            "geometry",
            lambda self, color: [Part("box", Box(1, 1, 1), body="trailer")],
            "geometry(color)[0].body: 'trailer'; it must be a body of poses(state): ''",
        ),
        (
            "geometry",
            lambda self, color: [Part("body", Mesh("nowhere.gltf"))],
            "geometry(color)[0].shape: ",
        ),
    ],
)
def test_what_a_member_returns_instead_is_named(
    member: str, wrong: Any, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Trolley, member, wrong)
    found = refusal(Trolley())
    assert found.startswith(f"vehicle.{member}")
    assert message in found


def test_parameters_are_those_that_a_file_can_hold() -> None:
    assert refusal(Trolley(gain="1")) == "vehicle.gain: '1'; it must be a number"  # type: ignore[arg-type]

    message = "vehicle.sides: (0.4,); it must be 2 values"
    assert refusal(Trolley(sides=(0.4,))) == message  # type: ignore[arg-type]

    class Undecorated(Vehicle):
        position = (0, 1)
        make_plant, make_controller = Trolley.make_plant, Trolley.make_controller  # type: ignore[assignment]

    assert "it must be a dataclass" in refusal(Undecorated())

    @dataclass
    class Placed(Trolley):
        folder: Path = field(default_factory=Path)

    message = refusal(Placed())
    assert message.startswith("vehicle.folder: of type Path; it must be float, int,")


def test_a_vehicle_does_not_take_the_name_of_a_shipped_one() -> None:
    message = refusal(dataclass(type("Car", (Trolley,), {}))())
    assert message.startswith("vehicle: 'Car'; it must be called otherwise, for !Blimp")
    assert isinstance(load_scenario("car-avoidance").vehicle, CarVehicle)


@pytest.mark.parametrize("kind", [Trolley, LongTrolley])
def test_tuples_and_derived_vehicles_are_dumped_and_loaded_back(
    kind: Callable[..., Trolley],
) -> None:
    scenario = scenario_with(kind(sides=(0.4, 0.3), marks=(1, 2, 3)))
    text = dump_scenario(scenario)
    assert parse_scenario(text, "dump.yaml") == scenario
    found = parse_scenario(text, "dump.yaml", "{vehicle: {marks: [4], sides: [1, 2]}}")
    assert found.vehicle.marks == (4,)  # type: ignore[attr-defined]
    assert found.vehicle.sides == (1.0, 2.0)  # type: ignore[attr-defined]
    with pytest.raises(ScenarioError, match=r"sides: \(1.0,\); it must be 2 values$"):
        parse_scenario(text, "dump.yaml", "{vehicle: {sides: [1]}}")


@pytest.mark.parametrize("wrong", [None, [1.0], "left", [[1.0, 2.0]]])
def test_a_law_returns_one_number_an_input(wrong: Any) -> None:
    scenario = scenario_with(led(wrong))
    for run in (check_assumptions, partial(simulate, step_time=False)):
        with pytest.raises(
            InvalidValueError, match=r"law returns: .*; it must be 2 numbers"
        ):
            run(scenario)


def test_a_law_without_a_number_is_found_before_the_run() -> None:
    message = r"reference at the start: \[nan, 0.0\]; it must be finite"
    with pytest.raises(InvalidValueError, match=message):
        check_assumptions(scenario_with(led([math.nan, 0.0])))


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"mass": 0.0}, "vehicle.mass: 0; it must be finite and above 0"),
        ({"mass": -1.0}, "vehicle.mass: -1; it must be finite and above 0"),
        ({"drag": -1.0}, "vehicle.drag: -1; it must be finite and not below 0"),
        ({"gain": float("nan")}, "vehicle.gain: nan; it must be a number"),
        ({"sides": (1.0, float("nan"))}, "vehicle.sides: (1.0, nan); it must be"),
        ({"inertia": 0.0}, "dx/dt at initial_state is at most 1e+15, not nan"),
        ({"inertia": 1e-300}, "dx/dt at initial_state is at most 1e+15, not 1e+300"),
    ],
)
def test_impossible_parameters_are_refused(
    parameters: dict[str, Any], message: str
) -> None:
    assert message in refusal(HeavyTrolley(**parameters))
