"""The contract of a vehicle: checks of what its members return."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
import math
from numbers import Integral
from pathlib import Path
import re
import types
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
from pydrake.geometry import Convex, Mesh
from pydrake.math import RigidTransform
from pydrake.systems.framework import System

from vcbf_drake.barriers import Barrier, StateInputLimit
from vcbf_drake.checks import Array, check_parameter, finite_array, require
from vcbf_drake.errors import InvalidValueError, below
from vcbf_drake.model.interface import (
    find_input_port,
    state_port_of,
    with_ports_held,
)
from vcbf_drake.plants.shapes import Part
from vcbf_drake.plants.vehicle import Vehicle, channels_of
from vcbf_drake.typed import check_fields, check_type, members_of, tag_of

_SCALARS = (float, int, bool, str, types.NoneType)
_LARGEST = 1e15  # Of a scenario's numbers, and of what its plant makes of them.
_COLOR = re.compile("#[0-9a-fA-F]{6}")


def checked_plant(vehicle: Vehicle) -> System:
    """Returns a vehicle's plant after checks of parameters, channels and position."""
    _check_parameters(vehicle)
    plant, at = vehicle.make_plant(), getattr(vehicle, "position", None)
    with below("vehicle"):
        require(isinstance(plant, System), "make_plant()", plant, "a Drake System")
        indices = range(state_port_of(plant).size())
        channels_of(plant)
        rule = f"indices of the state, whole numbers from 0 to {indices[-1]}"
        turn = vehicle.heading
        known = turn is None or (_are_whole([turn]) and turn in indices)
        require(known, "heading", turn, f"None, or one of the {rule}")
        if not callable(at):
            found = [*at] if isinstance(at, Sequence) else []
            known = _are_whole(found) and {*found} <= {*indices}
            known = known and 1 <= len({*found}) == len(found) <= 3
            rule = f"1 to 3 different {rule}, or a function of the state"
            require(known, "position", at, rule)
    return plant


def _are_whole(values: Sequence[Any]) -> bool:
    return all(isinstance(v, Integral) and not isinstance(v, bool) for v in values)


def num_coordinates(vehicle: Vehicle, state: Sequence[float]) -> int:
    """Returns the number of coordinates of a vehicle's position at a state (n,)."""
    at = vehicle.position
    if not callable(at):
        return len(at)
    path, rule = ("vehicle", "position(state)"), "1 to 3 finite numbers"
    found = at(np.array(state, dtype=float))
    place = finite_array(found, path, 1, rule)
    require(1 <= place.size <= 3, path, found, rule)
    return place.size


def check_returns(
    vehicle: Vehicle, state: Array, target: Sequence[float], inputs: Sequence[Array]
) -> None:
    """Checks the results of a vehicle's other members at the start of a run.

    `inputs` are the least and the greatest inputs.
    """
    _check_motion(vehicle, state, inputs)
    with below("vehicle"):
        _check_controller(vehicle.make_controller(target), vehicle.make_plant())
        check_type("barriers()", vehicle.barriers(), list[Barrier | StateInputLimit])
        check_type("pose(state)", vehicle.pose(state), RigidTransform)
        poses = vehicle.poses(state)
        check_type("poses(state)", poses, dict)
        for name, pose in poses.items():
            check_type(("poses(state)", name), pose, RigidTransform)
        _check_parts(vehicle.geometry("#000000"), [*poses])


def _check_parameters(vehicle: Vehicle) -> None:
    kind: Any = type(vehicle)
    rule = "a dataclass: write @dataclass above its class"
    require(is_dataclass(kind), "vehicle", kind.__name__, rule)
    shipped = [
        tag_of(each)
        for each in Vehicle.__subclasses__()
        if each.__module__.startswith("vcbf_drake.") and each is not kind
    ]
    rule = f"called otherwise, for {', '.join(shipped)} come with the package"
    require(tag_of(kind) not in shipped, "vehicle", kind.__name__, rule)
    hints = get_type_hints(kind)
    for each in fields(kind):
        if not _is_parameter(hints[each.name]):
            name = str(each.type).removeprefix("<class '").removesuffix("'>")
            problem = f"of type {name}; it must be float, int, bool, str, a list or"
            problem += " tuple of one of these, or a dataclass of such fields"
            raise InvalidValueError(("vehicle", each.name), problem)
    with below("vehicle"):
        check_fields(vehicle)
        _check_numbers(vehicle)


def _is_parameter(hint: Any) -> bool:
    """Whether a scenario file can hold values of a type."""
    return all(map(_is_member, members_of(hint)))


def _is_member(hint: Any) -> bool:
    items = {each for each in get_args(hint) if each is not Ellipsis}
    if get_origin(hint) in (list, tuple, Sequence):
        return len(items) == 1 and _is_parameter(*items)
    if is_dataclass(hint):
        hints = get_type_hints(hint)
        return all(_is_parameter(hints[each.name]) for each in fields(hint))
    return hint in _SCALARS or get_origin(hint) is Literal


def _check_motion(vehicle: Vehicle, state: Array, inputs: Sequence[Array]) -> None:
    """Checks that the plant's derivatives are finite, unlike with a zero mass."""
    plant = vehicle.make_plant()
    context = plant.CreateDefaultContext()
    if context.num_continuous_states() != len(state):
        return  # Whoever derives its model says so.
    context.SetContinuousState(state)

    def rate() -> Array:
        derivatives: Array = plant.EvalTimeDerivatives(context).CopyToVector()
        return derivatives

    for u in [np.zeros_like(inputs[0]), *inputs]:
        find_input_port(plant).FixValue(context, np.where(np.isfinite(u), u, 0.0))
        try:
            with np.errstate(all="ignore"):
                most = float(np.abs(with_ports_held(plant, context, rate)).max())
        except (ArithmeticError, ValueError):  # Divided by 0; the root of -1.
            most = math.nan
        rule = f"one whose dx/dt at initial_state is at most {_LARGEST:g}, not {most:g}"
        require(most <= _LARGEST, "vehicle", repr(vehicle)[:200], rule)


def _check_numbers(made: Any) -> None:
    """Checks that no field is nan, and the ranges of mass and drag."""
    for each in fields(made):
        value = getattr(made, each.name)
        if is_dataclass(value):
            with below(each.name):
                _check_numbers(value)
        elif isinstance(value, float | list | tuple | np.ndarray):
            numbers = np.ravel(np.array(value, dtype=object))
            is_nan = any(isinstance(v, float) and math.isnan(v) for v in numbers)
            require(not is_nan, each.name, value, "a number")
    for name, zero_allowed in (("mass", False), ("drag", True)):
        if isinstance(found := getattr(made, name, None), float | int):
            check_parameter(name, found, zero_allowed=zero_allowed)


def _check_controller(controller: Any, plant: System) -> None:
    where = "make_controller(target)"
    require(isinstance(controller, System), where, controller, "a Drake System")
    inputs = map(controller.get_input_port, range(controller.num_input_ports()))
    outputs = map(controller.get_output_port, range(controller.num_output_ports()))
    for kind, ports, name, size in (
        ("input", inputs, "state", state_port_of(plant).size()),
        ("output", outputs, "reference", find_input_port(plant).size()),
    ):
        found = {port.get_name(): port.size() for port in ports}
        rule = f"a system with {kind} port {name} of size {size}"
        require(found.get(name) == size, f"{where}, {kind} ports", found, rule)


def _check_parts(parts: Any, bodies: Sequence[str]) -> None:
    check_type("geometry(color)", parts, list[Part])
    for i, part in enumerate(parts):
        place = "geometry(color)", i
        known = part.color is None or bool(_COLOR.fullmatch(str(part.color)))
        rule = "hexadecimal, #rrggbb, or None"
        require(known, (*place, "color"), part.color, rule)
        rule = f"a body of poses(state): {', '.join(map(repr, bodies))}"
        require(part.body in bodies, (*place, "body"), part.body, rule)
        if isinstance(part.shape, Mesh | Convex) and part.shape.source().is_path():
            file = Path(part.shape.source().path())
            require(file.is_file(), (*place, "shape"), str(file), "a file that exists")
