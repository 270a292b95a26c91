"""Outputs of a MultibodyPlant, the arguments of barriers, and their jets."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.symbolic import Expression, Variable

from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.compiled import Expressions

if TYPE_CHECKING:
    from vcbf_drake.model.multibody_model import MultibodyModel


@dataclass(frozen=True)
class StateOutput:
    """One entry of the state: a position or a velocity.

    Attributes:
        index: The index of the entry.
    """

    index: int

    def value(self, model: MultibodyModel, x: Array) -> float:
        """Returns z."""
        return float(x[self.index])

    def jet(self, model: MultibodyModel, x: Array, order: int) -> Array:
        """Returns [z, dz/dt, a, b, c], shape (3 + m + q,); see `jets`."""
        f, g = model.at(x).parts
        i = self._moved(model, order)
        E = model.disturbance_matrix
        return np.concatenate([[x[self.index], x[i], f[i]], g[i], E[i]])

    def jet_by_state(self, model: MultibodyModel, x: Array, order: int) -> Array:
        """Returns the jet's derivatives by x, shape (3 + m + q, n)."""
        f_x, g_x = model.at(x).sensitivity
        i, unit = self._moved(model, order), np.eye(len(x))
        still = np.zeros((model.num_disturbances, len(x)))
        return np.vstack([unit[self.index], unit[i], f_x[i], g_x[i], still])

    def _moved(self, model: MultibodyModel, order: int) -> int:
        """The state whose derivative contains the inputs, up to an order."""
        if order == 1:
            return self.index
        if self.index not in model.velocity_of_position:
            raise ModelError(
                f"h is a function of {model.state_names[self.index]}, whose rate is no"
                " velocity of the plant: take points of its bodies (point_position),"
                " or other states"
            )
        return model.velocity_of_position[self.index]


@dataclass(frozen=True)
class PointOutput:
    """One world coordinate of a point of a body.

    Attributes:
        frame: The name of the frame or body that the point moves with.
        offset: The point in that frame, shape (3,) [m].
        axis: The index of the coordinate.
    """

    frame: str
    offset: tuple[float, ...]
    axis: int

    def value(self, model: MultibodyModel, x: Array) -> float:
        """Returns z [m]."""
        return float(model.at(x).place(self.frame, self.offset)[self.axis])

    def jet(self, model: MultibodyModel, x: Array, order: int) -> Array:
        """Returns [z, dz/dt, a, b, c], shape (3 + m + q,); see `jets`."""
        return self._jet(model.at(x).point(self.frame, self.offset), order)

    def jet_by_state(self, model: MultibodyModel, x: Array, order: int) -> Array:
        """Returns the jet's derivatives by x, shape (3 + m + q, n)."""
        return self._jet(model.at(x).point_sensitivity(self.frame, self.offset), order)

    def _jet(self, point: Array, order: int) -> Array:
        jet = point[self.axis]
        if order == 2:
            return jet
        return np.concatenate([jet[:2], jet[1:2], np.zeros_like(jet[3:])])


Output = StateOutput | PointOutput


def jets(
    model: MultibodyModel, x: Array, outputs: Iterable[Output], order: int
) -> Array:
    """Returns the jets [z, dz/dt, a, b, c] of outputs, shape (k, 3 + m + q).

    The derivative of z of the given order, 1 or 2, is a + b u + c d.
    """
    return np.array([each.jet(model, x, order) for each in outputs])


def jets_by_state(
    model: MultibodyModel, x: Array, outputs: Iterable[Output], order: int
) -> Array:
    """Returns the derivatives of `jets` by x, shape (k, 3 + m + q, n)."""
    return np.array([each.jet_by_state(model, x, order) for each in outputs])


class OutputSymbols(np.ndarray):
    """The symbolic state of a MultibodyPlant, with variables for its points.

    A `point_position` of the same plant takes one variable per coordinate from it, in
    place of a formula that would grow too large.
    """

    plant: Any
    points: dict[PointOutput, Variable]

    @staticmethod
    def of(model: MultibodyModel) -> OutputSymbols:
        """Returns the state of a model, shape (n,)."""
        state = np.array([Expression(v) for v in model.state], dtype=object)
        symbols = state.view(OutputSymbols)
        symbols.plant, symbols.points = model.plant, {}
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
            output = PointOutput(frame, offset, axis)
            name = f"{frame}{offset}[{axis}]"
            found.append(self.points.setdefault(output, Variable(name)))
        return np.array([Expression(v) for v in found], dtype=object)
