"""The chain of a barrier: its levels up to the derivative that the input enters.

The number of that derivative is the relative degree.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.barriers.barrier import Barrier
from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.control_affine import ControlAffineModel, Dynamics
from vcbf_drake.model.formulas import CompiledFunction, compile_nodes
from vcbf_drake.model.graph import (
    ZERO,
    Node,
    Nodes,
    gradients,
    substitute,
    variable,
)

TIME, LEVEL = variable("t"), variable("level")
_NUM_SAMPLES = 8
_SEARCHED_BEYOND = 2  # Further derivatives that an error message considers.


def nodes(prefix: str, size: int) -> tuple[Node, ...]:
    """Returns the variables prefix0, prefix1, ..."""
    return tuple(variable(f"{prefix}{i}") for i in range(size))


class Formula(NamedTuple):
    """The formula that a barrier's chain is derived from; equal for equal barriers.

    Attributes:
        h: The barrier.
        dynamics: The model's.
        parameters: The parameters of h.
        order: The relative degree r.
        robust: Whether the disturbance may enter before the input (E8).
        class_k: The class-K function (E10), a formula of `LEVEL`; None for lambda_r
            phi.
    """

    h: Node
    dynamics: Dynamics
    parameters: tuple[Node, ...]
    order: int
    robust: bool
    class_k: Node | None = None


@contextmanager
def _derived() -> Iterator[None]:
    """Explains, by a ModelError, that a formula has too few derivatives."""
    try:
        yield
    except ValueError as error:
        raise ModelError(
            "function(x, t, p) cannot be differentiated as often as needed: write it"
            f" without abs and without the root of a square ({error})"
        ) from None


@dataclass(frozen=True, eq=False)
class Chain:
    """The functions phi^0 = h, ..., phi^(r-1); the input enters the last one's rate.

    Each is the previous one's rate along the extended drift plus lambda times it (E3);
    a robust chain subtracts the worst case of a bounded disturbance (E8). The plain
    chain is the robust one with the bound 0.

    Attributes:
        formula: The formula that it was derived from.
        levels: phi^0, ..., phi^(r-1).
        constants: The numbers that they depend on beside x and t: the decay rates
            lambda_i, the bound and the smoothing of a robust chain, the parameters.
    """

    formula: Formula
    levels: tuple[Node, ...]
    constants: tuple[Node, ...]

    @staticmethod
    @lru_cache(maxsize=256)
    @_derived()
    def of(formula: Formula) -> Chain:
        """Derives the chain, or raises a ModelError for want of derivatives."""
        dynamics, robust = formula.dynamics, formula.robust
        rates = nodes("lambda", formula.order)
        disturbance = (variable("bound"), variable("smoothing")) if robust else ()
        levels = [formula.h]
        for rate in rates[:-1]:
            level = levels[-1]
            worst = ZERO
            if disturbance:
                bound, smoothing = disturbance
                w = [e for e in dynamics.disturbance_rates(level) if e is not ZERO]
                squares = sum((e * e for e in w), start=smoothing * smoothing)
                worst = bound * squares**0.5 if w else ZERO
            levels.append(dynamics.drift_rate(level, TIME) - worst + rate * level)
        constants = (*rates, *disturbance, *formula.parameters)
        return Chain(formula, tuple(levels), constants)

    def row(self) -> Nodes:
        """Returns [A, b, w] of the last level's row (E5), (E9), shape (m + 1 + q,)."""
        dynamics, last = self.formula.dynamics, self.levels[-1]
        pull = self.constants[self.formula.order - 1] * last
        if self.formula.class_k is not None:
            (pull,) = substitute([self.formula.class_k], {LEVEL: last})
        A = -dynamics.input_rates(last)
        b = dynamics.drift_rate(last, TIME) + pull
        return np.array([*A, b, *dynamics.disturbance_rates(last)], dtype=object)

    @cached_property
    @_derived()
    def slopes(self) -> CompiledFunction:
        """A function of x, t and the constants: every level's gradient by x."""
        x = self.formula.dynamics.x
        slopes = gradients(self.levels, x).ravel()
        return compile_nodes([*x, TIME, *self.constants], slopes, "barrier_slopes")

    @cached_property
    def written(self) -> NDArray[np.bool_]:
        """Whether each level's rate contains each channel, shape (r, m + q)."""
        dynamics = self.formula.dynamics
        rates = [
            [*dynamics.input_rates(level), *dynamics.disturbance_rates(level)]
            for level in self.levels
        ]
        return np.array([[rate is not ZERO for rate in row] for row in rates])


class ChainFunctions(NamedTuple):
    """A barrier's chain as functions of plain floats.

    Attributes:
        row: ``row(*x, t, *constants)`` returns [A, b, w], then phi^0, ..., phi^(r-1).
        gradient: ``gradient(*x, t, *constants)`` returns the derivatives of [A, b, w]
            by [x; t], in C order.
        value: ``value(*x, t, *parameters)`` returns [h].
    """

    row: CompiledFunction
    gradient: CompiledFunction
    value: CompiledFunction


@lru_cache(maxsize=256)
@_derived()
def compiled_chain(
    formula: Formula, moving: tuple[Node, ...], of_h: tuple[Node, ...]
) -> ChainFunctions:
    """Returns the functions of a barrier's chain, for any constants.

    The x of `row` and `gradient` is `moving`, the state or the jets of its outputs;
    that of `value` is `of_h`.
    """
    chain = Chain.of(formula)
    row, gradient = compiled_row(
        tuple(chain.row()), chain.levels, moving, chain.constants
    )
    arguments = [*of_h, TIME, *formula.parameters]
    value = compile_nodes(arguments, [formula.h], "barrier_value")
    return ChainFunctions(row, gradient, value)


@lru_cache(maxsize=256)
@_derived()
def compiled_row(
    entries: tuple[Node, ...],
    levels: tuple[Node, ...],
    x: tuple[Node, ...],
    constants: tuple[Node, ...],
) -> tuple[CompiledFunction, CompiledFunction]:
    """Returns a row's entries [A, b, w], followed by levels, and the entries' gradient.

    Both are functions of x, t and the constants, as in `ChainFunctions`.
    """
    xbar = [*x, TIME]
    slopes, arguments = gradients(entries, xbar).ravel(), [*xbar, *constants]
    return (
        compile_nodes(arguments, [*entries, *levels], "row"),
        compile_nodes(arguments, slopes, "row_gradient"),
    )


def early_levels(
    model: ControlAffineModel, chain: Chain, barrier: Barrier
) -> tuple[int, ...]:
    """Returns which derivatives of h below the last an input enters (E8a).

    In general there are none. At least one input must enter the r-th derivative first;
    the disturbance must enter no earlier than that, unless the chain is robust (R2),
    (E8).

    Raises:
        ModelError: All inputs enter earlier or later, or the disturbance earlier.
    """
    r = barrier.relative_degree
    entered = _entered(model, chain, barrier.constants)
    degrees = _first_level(entered)
    inputs, disturbances = degrees[: model.num_inputs], degrees[model.num_inputs :]
    first = inputs.min(initial=np.inf)
    has_early_disturbance = (
        disturbances.min(initial=np.inf) < r and not chain.formula.robust
    )
    if first < r and (r not in inputs or has_early_disturbance):
        early = inputs.argmin()
        raise ModelError(
            f"input {early} enters derivative {first:.0f} of h, so its relative degree"
            f" is {first:.0f}, not {r}: give {_gains(first)}"
        )
    if has_early_disturbance:
        channel = int(disturbances.argmin())
        raise ModelError(
            f"disturbance {channel} (on {_disturbed(model, channel)}) enters derivative"
            f" {disturbances[channel]:.0f} of h, but the inputs enter none before {r},"
            " so the lower derivatives are not known (R2): leave that disturbance out,"
            " choose an h that it enters no earlier than the input, or take"
            " barrier.robust_to(bound)"
        )
    if np.isinf(first):
        raise ModelError(_explain_higher_degree(model, chain, barrier))
    by_input = entered[: r - 1, : model.num_inputs].any(axis=1)
    return tuple((np.flatnonzero(by_input) + 1).tolist())


def _explain_higher_degree(
    model: ControlAffineModel, chain: Chain, barrier: Barrier
) -> str:
    """The message for a barrier whose first r derivatives no input enters."""
    r = barrier.relative_degree
    searched = max(r, min(r + _SEARCHED_BEYOND, model.num_states))
    plain = chain.formula._replace(order=searched, robust=False, class_k=None)
    further = Chain.of(plain)
    constants = [*np.ones(searched), *barrier.parameters]
    entered = _entered(model, further, constants)
    degree = _first_level(entered)[: model.num_inputs].min(initial=np.inf)
    if np.isinf(degree):
        return (
            f"no input enters a derivative of h up to order {searched}: choose an h of"
            f" states that the inputs of {model.name} move"
        )
    return (
        f"no input enters derivative {r} of h, its relative degree is {degree:.0f}:"
        f" give {_gains(degree)}"
    )


def _first_level(entered: NDArray[np.bool_]) -> Array:
    """Which derivative of h each channel enters first; infinite for none."""
    return np.where(entered.any(axis=0), entered.argmax(axis=0) + 1.0, np.inf)


def _entered(
    model: ControlAffineModel, chain: Chain, constants: Sequence[float]
) -> NDArray[np.bool_]:
    """Returns which channel enters the derivative of which level, (r, m + q).

    A channel does not enter where its formula is zero, or is zero at every sample up to
    rounding. Where no sample can be evaluated, the formula alone decides.
    """
    slopes, written, n = chain.slopes, chain.written, model.num_states
    seen = np.zeros_like(written)
    evaluated = False
    for point in _samples(n):
        if (seen == written).all():
            break
        try:
            values = np.reshape(slopes(*point, *constants), (-1, n))
            _, g = model.drift_and_input_matrix(np.array(point[:n]))
        except (ArithmeticError, ValueError):  # Outside the domain of h or the model.
            continue
        columns = np.hstack([g, model.disturbance_matrix])
        if np.isfinite(values).all() and np.isfinite(columns).all():
            evaluated = True
            scale = np.outer(np.abs(values).max(axis=1), np.abs(columns).sum(axis=0))
            seen |= written & (np.abs(values @ columns) > 1e-12 * scale)
    return seen if evaluated or not written.any() else written


@lru_cache
def _samples(num_states: int) -> list[tuple[float, ...]]:
    """The points [x; t] of several magnitudes, the same ones every time."""
    generator, samples = np.random.default_rng(0), []
    for magnitude in np.geomspace(0.1, 10.0, _NUM_SAMPLES).tolist():
        state = magnitude * generator.standard_normal(num_states)
        samples.append((*state.tolist(), magnitude))
    return samples


def _gains(number: float) -> str:
    return f"{number:.0f} gain{'' if number == 1 else 's'}"


def _disturbed(model: ControlAffineModel, channel: int) -> str:
    """The names of the states that a disturbance channel acts on."""
    acted_on = np.flatnonzero(model.disturbance_matrix[:, channel])
    return ", ".join(model.state_names[i] for i in acted_on)
