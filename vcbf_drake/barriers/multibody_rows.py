"""Barrier rows on a MultibodyPlant: functions of outputs that Drake evaluates.

For a barrier the plant is a chain of integrators of its outputs (E14, rows of outputs),
or of these and their rates (E15, rows of their rates), whose inputs are numbers that
depend on the state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vcbf_drake.barriers.chain import ChainFunctions, Formula, compiled_chain
from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.control_affine import Dynamics, rows_of
from vcbf_drake.model.graph import (
    ZERO,
    Node,
    Nodes,
    substitute,
    variable,
    variables_of,
)
from vcbf_drake.model.multibody_model import MultibodyModel, Output
from vcbf_drake.model.numeric_dynamics import regular_state
from vcbf_drake.model.position import PointCoordinate


@dataclass(frozen=True)
class MultibodyRow:
    """The functions of one barrier's row at a state, as in `ChainFunctions`.

    Attributes:
        model: The plant.
        outputs: The k outputs z.
        order: The relative degree r, 1 or 2.
        functions: h of (z, t, p), and its row of (jets, t, constants).
    """

    model: MultibodyModel
    outputs: tuple[Output, ...]
    order: int
    functions: ChainFunctions

    def value(self, *arguments: float) -> list[float]:
        """Returns [h] at (x, t, p)."""
        x, rest = self._split(arguments)
        z = map(self.model.at(x).value, self.outputs)
        return self.functions.value(*z, *rest)

    def row(self, *arguments: float) -> list[float]:
        """Returns [A, b, w] and the chain at (x, t, constants)."""
        x, rest = self._split(arguments)
        motion = self.model.at(x)
        jets = [motion.jet(each, self.order) for each in self.outputs]
        return self.functions.row(*np.ravel(jets).tolist(), *rest)

    def gradient(self, *arguments: float) -> list[float]:
        """Returns the derivatives of [A, b, w] by [x; t], in C order."""
        x, rest = self._split(arguments)
        motion, order = self.model.at(x), self.order
        jets = np.ravel([motion.jet(each, order) for each in self.outputs])
        by_state = [motion.jet_by_state(each, order) for each in self.outputs]
        flat = self.functions.gradient(*jets.tolist(), *rest)
        by_jets = np.array(flat).reshape(-1, jets.size + 1)
        by_x = by_jets[:, :-1] @ np.reshape(by_state, (jets.size, -1))
        found: list[float] = np.column_stack([by_x, by_jets[:, -1]]).ravel().tolist()
        return found

    def _split(self, arguments: tuple[float, ...]) -> tuple[Array, tuple[float, ...]]:
        n = self.model.num_states
        return np.array(arguments[:n]), arguments[n:]


def multibody_functions(
    model: MultibodyModel,
    formula: Formula,
    points: Mapping[Node, PointCoordinate],
    constants: Sequence[float],
) -> ChainFunctions:
    """Returns a barrier's functions on a MultibodyPlant, its relative degree checked.

    The barrier is a formula of states and of the nodes of points.
    """
    states = {node: i for i, node in enumerate(model.dynamics.x)}
    used, order = variables_of([formula.h]), formula.order
    known: dict[Node, Output] = {**states, **points}
    chosen = {node: output for node, output in known.items() if node in used}
    outputs = tuple(chosen.values())
    _require_order(model, outputs, order)
    jet = _jet(len(outputs), model.num_inputs, model.num_disturbances)
    (h,) = substitute([formula.h], dict(zip(chosen, jet[:, 0], strict=True)))
    moved = formula._replace(h=h, dynamics=_integrators(jet, model.num_inputs, order))
    functions = compiled_chain(moved, tuple(jet.flat), tuple(jet[:, 0]))
    row = MultibodyRow(model, outputs, order, functions)
    _require_authority(row, constants)
    return ChainFunctions(row.row, row.gradient, row.value)


def _jet(size: int, num_inputs: int, num_disturbances: int) -> Nodes:
    """The variables [z, dz, a, b, c] of some outputs, shape (k, 3 + m + q)."""
    columns = [
        *("z", "dz", "a"),
        *(f"b{j}_" for j in range(num_inputs)),
        *(f"c{j}_" for j in range(num_disturbances)),
    ]
    nodes = [[variable(f"{name}{i}") for name in columns] for i in range(size)]
    return np.array(nodes, dtype=object).reshape(size, len(columns))


def _integrators(jet: Nodes, num_inputs: int, order: int) -> Dynamics:
    """The outputs' dynamics, of z (E14) or of z and dz (E15)."""
    k, (z, dz, a) = len(jet), jet[:, :3].T
    b, c = jet[:, 3 : 3 + num_inputs], jet[:, 3 + num_inputs :]
    if order == 1:
        return Dynamics(tuple(z), tuple(a), rows_of(b), rows_of(c))
    none = np.full((k, 1), ZERO)
    b = np.vstack([np.repeat(none, b.shape[1], axis=1), b])
    c = np.vstack([np.repeat(none, c.shape[1], axis=1), c])
    return Dynamics((*z, *dz), (*dz, *a), rows_of(b), rows_of(c))


def _require_order(
    model: MultibodyModel, outputs: Sequence[Output], order: int
) -> None:
    """Checks that the number of gains is the derivative order that forces enter."""
    if not outputs:
        raise ModelError(_no_authority(model, order))
    has_velocity = any(
        isinstance(each, int) and each >= model.num_positions for each in outputs
    )
    degree = 1 if has_velocity else 2
    if order != degree:
        what = "a velocity" if has_velocity else "positions alone"
        raise ModelError(
            f"h is a function of {what}, so its relative degree is {degree}, not"
            f" {order}: give {degree} gain{'s' if degree > 1 else ''}"
        )


def _require_authority(row: MultibodyRow, constants: Sequence[float]) -> None:
    """Checks that an input enters the row at one of a few seeded states."""
    random, m = np.random.default_rng(0), row.model.num_inputs
    for scale in np.geomspace(0.1, 3.0, 8):
        x = regular_state(row.model.state_names, random, scale)
        try:
            entries = row.row(*x, 0.3, *constants)
        except (ArithmeticError, ValueError):  # Outside the domain of h.
            continue
        if np.abs(entries[:m]).max() > 1e-12 * np.abs(entries).max():
            return
    raise ModelError(_no_authority(row.model, row.order))


def _no_authority(model: MultibodyModel, order: int) -> str:
    return (
        f"no input enters derivative {order} of h: choose an h of states that the"
        f" inputs of {model.name} move"
    )
