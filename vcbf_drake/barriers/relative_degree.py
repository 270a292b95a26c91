"""Which derivative of a barrier each input and each disturbance enters first."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from pydrake.symbolic import Evaluate, Expression, Variable

from vcbf_drake.barriers.formula import Symbols
from vcbf_drake.barriers.lie_derivatives import LieDerivatives, gradient
from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.compiled import Expressions
from vcbf_drake.model.control_affine import ControlAffineModel

_NUM_SAMPLES = 8
_SEARCHED_BEYOND = 2  # How many more derivatives an error message looks at.


def check_relative_degree(
    derivatives: LieDerivatives, parameters: Array, robust: bool = False
) -> None:
    """Checks that the input enters L_f^r h first, and the disturbance no earlier (R2).

    Args:
        derivatives: h, L_f h, ..., L_f^r h.
        parameters: The values of h's parameters, shape (k,).
        robust: Whether the disturbance may come earlier (E70).

    Raises:
        ModelError: The input enters earlier or later, or the disturbance earlier.
    """
    r, model = derivatives.order, derivatives.symbols.model
    inputs, disturbances = _relative_degrees(derivatives, parameters, r)
    first = inputs.min(initial=np.inf)
    first_disturbance = disturbances.min(initial=np.inf)
    if first < r:
        raise ModelError(
            f"input {inputs.argmin()} enters derivative {first:.0f} of h, so its"
            f" relative degree is {first:.0f}, not {r}: give {_gains(first)}"
        )
    if first_disturbance < r and not robust:
        channel = int(disturbances.argmin())
        raise ModelError(
            f"disturbance {channel} (on {_disturbed(model, channel)}) enters derivative"
            f" {first_disturbance:.0f} of h, but the inputs enter none before {r}, so"
            " the lower derivatives are not known (R2): leave that disturbance out,"
            " choose an h that it enters no earlier than the input, or take"
            " barrier.robust_to(bound)"
        )
    if np.isinf(first):
        raise ModelError(_explain_higher_degree(derivatives, parameters))


def _explain_higher_degree(derivatives: LieDerivatives, parameters: Array) -> str:
    """Returns the message for a barrier whose first r derivatives no input enters."""
    r, symbols = derivatives.order, derivatives.symbols
    searched = max(r, min(r + _SEARCHED_BEYOND, symbols.model.num_states))
    further = LieDerivatives.of(derivatives.expressions[0], symbols, searched)
    inputs, _ = _relative_degrees(further, parameters, searched)
    degree = inputs.min(initial=np.inf)
    if np.isinf(degree):
        return (
            f"no input enters a derivative of h up to order {searched}: choose an h of"
            f" states that the inputs of {symbols.model.name} move"
        )
    return (
        f"no input enters derivative {r} of h, its relative degree is {degree:.0f}:"
        f" give {_gains(degree)}"
    )


def _relative_degrees(
    derivatives: LieDerivatives, parameters: Array, up_to: int
) -> tuple[Array, Array]:
    """Returns which derivative of h each input and each disturbance enters first.

    Shapes (m,) and (q,); infinite for a channel that enters none of them.
    """
    model = derivatives.symbols.model
    channels = np.hstack([model.input_matrix_expressions, model.disturbance_matrix])
    degrees = np.full(channels.shape[1], np.inf)
    for k, derivative in enumerate(derivatives.expressions[:up_to], start=1):
        samples = _samples(derivatives.symbols, parameters)
        enters = _is_nonzero(gradient(derivative, model.state), channels, samples)
        degrees[enters & np.isinf(degrees)] = k
    return degrees[: model.num_inputs], degrees[model.num_inputs :]


def _is_nonzero(
    slope: Expressions, channels: Expressions, samples: Iterator[dict[Variable, float]]
) -> NDArray[np.bool_]:
    """Returns which entries of ``slope @ channels`` are not zero everywhere.

    An entry is zero if its expression is, or else if it is at every sample, up to
    rounding. Where no sample can be evaluated, the expression alone decides.
    """
    zero = Expression(0.0)
    written = np.array([not e.EqualTo(zero) for e in slope @ channels], dtype=bool)
    if not written.any():
        return written
    seen: list[NDArray[np.bool_]] = []
    for sample in samples:
        if seen and (written <= np.any(seen, axis=0)).all():
            break
        try:
            values = Evaluate(np.vstack([slope, channels.T]), sample)
        except (RuntimeError, ValueError):  # Outside the domain of h or of the model.
            continue
        if np.isfinite(values).all():
            products = values[1:] @ values[0]
            scale = np.abs(values[1:]).sum(axis=1) * np.abs(values[0]).max()
            seen.append(np.abs(products) > 1e-12 * scale)
    return written & np.any(seen, axis=0) if seen else written


def _samples(symbols: Symbols, parameters: Array) -> Iterator[dict[Variable, float]]:
    """Yields states and times of several magnitudes, the same ones every time."""
    generator = np.random.default_rng(0)
    for magnitude in np.geomspace(0.1, 10.0, _NUM_SAMPLES):
        state = magnitude * generator.standard_normal(symbols.model.num_states)
        values = [*state, magnitude, *parameters]
        yield dict(zip(symbols.variables, values, strict=True))


def _gains(number: float) -> str:
    return f"{number:.0f} gain{'' if number == 1 else 's'}"


def _disturbed(model: ControlAffineModel, channel: int) -> str:
    """Returns the names of the states a disturbance channel acts on."""
    acted_on = np.flatnonzero(model.disturbance_matrix[:, channel])
    return ", ".join(model.state_names[i] for i in acted_on)
