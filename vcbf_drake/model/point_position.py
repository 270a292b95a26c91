"""Where a point of a MultibodyPlant's body is: forward kinematics as a formula."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.compiled import Expressions
from vcbf_drake.model.massless_bodies import give_mass


def point_position(
    plant: Any,
    frame: str,
    point: Sequence[float] | Array = (0.0, 0.0, 0.0),
    axes: Sequence[int] = (0, 1, 2),
) -> Callable[[Expressions], Expressions]:
    """Returns the world position of a body's point as a function of the symbolic state.

    It is what barriers take as ``position``: a half-space, a sphere or a box then holds
    for that point of a robot arm. The state begins with the plant's positions q.

    Args:
        plant: A finalised MultibodyPlant.
        frame: The name of the frame, or body, that the point moves with.
        point: The point's coordinates in that frame, shape (3,) [m].
        axes: Which world coordinates to return.

    Raises:
        ModelError: The plant does not convert to symbolic, or has no such frame.
    """
    try:
        symbolic = plant.ToSymbolic()
        moving = symbolic.GetFrameByName(frame)
    except RuntimeError as error:
        raise ModelError(f"{plant.get_name()}: {error}") from error
    context = symbolic.CreateDefaultContext()
    give_mass(symbolic, context)  # Positions do not depend on it.
    in_numbers = plant, plant.GetFrameByName(frame), plant.CreateDefaultContext()
    in_symbols = symbolic, moving, context
    chosen, offset = list(axes), np.array(point, dtype=float)

    def position(x: Expressions) -> Expressions:
        numbers = x.dtype == float
        tree, moving, context = in_numbers if numbers else in_symbols
        tree.SetPositions(context, x[: tree.num_positions()])
        world = tree.world_frame()
        points = tree.CalcPointsPositions(context, moving, offset, world)
        coordinates: Expressions = points[chosen, 0]
        return coordinates

    return position
