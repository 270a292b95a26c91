"""The position of a robot: some of its states, or a function of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.symbolic import Expression, Variable

from vcbf_drake.checks import Array, finite_array, require
from vcbf_drake.errors import ModelError
from vcbf_drake.model.formulas import Expressions
from vcbf_drake.model.multibody_parts import frames_of
from vcbf_drake.model.symbolic_dynamics import give_mass, to_symbolic
from vcbf_drake.typed import typed

PositionFunction: TypeAlias = Callable[[Expressions], Expressions]
Position: TypeAlias = Sequence[int] | PositionFunction
"""Indices of k states, or a function from the symbolic x (n,) to the position (k,)."""


def named_position(state_names: Sequence[str]) -> tuple[int, ...] | None:
    """Returns the indices of the states x and y, or x, y and z; None without them.

    A MultibodyPlant names those of a planar or free body "body_x", "body_y", "body_z".
    """
    found = []
    for axis in "xyz":
        named = [
            i
            for i, name in enumerate(state_names)
            if name == axis or name.endswith(f"_{axis}")
        ]
        if len(named) > 1:
            return None
        found += named
    return tuple(found) if len(found) >= 2 else None


class PointCoordinate(NamedTuple):
    """A world coordinate of a body's point: frame, place in it (3,) [m] and axis."""

    frame: str
    offset: tuple[float, ...]
    axis: int


class PlantSymbols(np.ndarray):
    """The symbolic state of a MultibodyPlant, with variables for its points.

    A `point_position` of the same plant takes one variable per coordinate from it, in
    place of a formula that would grow too large.
    """

    plant: Any
    points: dict[PointCoordinate, Variable]

    @staticmethod
    def of(plant: MultibodyPlant, state: Expressions) -> PlantSymbols:
        """Returns the state of a plant, shape (n,)."""
        symbols = np.array([Expression(v) for v in state]).view(PlantSymbols)
        symbols.plant, symbols.points = plant, {}
        return symbols

    def __array_finalize__(self, origin: Any) -> None:
        self.plant = getattr(origin, "plant", None)
        self.points = getattr(origin, "points", {})

    def point(
        self, frame: str, offset: tuple[float, ...], axes: Iterable[int]
    ) -> Expressions:
        """Returns a variable for each of some coordinates of a point, shape (k,)."""
        found = []
        for axis in axes:
            name = f"{frame}{offset}[{axis}]"
            coordinate = PointCoordinate(frame, offset, axis)
            found.append(self.points.setdefault(coordinate, Variable(name)))
        return np.array([Expression(v) for v in found])


@typed
def point_position(
    plant: MultibodyPlant,
    frame: str,
    point: Sequence[float] | Array = (0.0, 0.0, 0.0),
    axes: Sequence[int] = (0, 1, 2),
) -> PositionFunction:
    """Returns the world position of a body's point as a function of the state.

    Barriers accept it as ``position``: a half-space, a sphere or a box then applies to
    that point of a robot arm. The state begins with the plant's positions q.

    Args:
        plant: A finalised MultibodyPlant.
        frame: The name of the frame, or body, that the point moves with.
        point: The point's coordinates in that frame, shape (3,) [m].
        axes: The world coordinates to return.

    Raises:
        ModelError: The plant has no such frame; when the position is called, that it
            does not convert to symbolic where symbols are needed.
    """
    rule = "3 finite numbers, the point in its frame [m]"
    offset = finite_array(point, "point", 1, rule)
    require(offset.shape == (3,), "point", point, rule)
    chosen = list(axes)
    known = 1 <= len(chosen) == len(set(chosen)) and set(chosen) <= {0, 1, 2}
    require(known, "axes", axes, "some of 0, 1 and 2, each once")
    name = plant.get_name() or "plant"
    if not plant.is_finalized():
        raise ModelError(f"{name}: point_position needs a plant that is finalised")
    if not plant.HasFrameNamed(frame):
        there = ", ".join(frames_of(plant))
        raise ModelError(f"{name}: there is no frame {frame!r}; its frames are {there}")
    in_numbers = plant, plant.GetFrameByName(frame), plant.CreateDefaultContext()

    @cache
    def in_symbols() -> Any:
        symbolic = to_symbolic(plant, name)
        context = symbolic.CreateDefaultContext()
        give_mass(symbolic, context)  # Positions do not depend on it.
        return symbolic, symbolic.GetFrameByName(frame), context

    def position(x: Expressions) -> Expressions:
        if isinstance(x, PlantSymbols):
            if x.plant is plant:
                return x.point(frame, tuple(offset.tolist()), chosen)
            size, of_plant = plant.num_positions(), x.plant.num_positions()
            if size != of_plant:
                raise ModelError(
                    f"point_position is of {name}, which has {size} positions; the"
                    f" filter's plant has {of_plant}"
                )
        tree, moving, context = in_numbers if x.dtype == float else in_symbols()
        tree.SetPositions(context, x[: tree.num_positions()])
        world = tree.world_frame()
        points = tree.CalcPointsPositions(context, moving, offset, world)
        coordinates: Expressions = points[chosen, 0]
        return coordinates

    return position
