"""Which derivative of a barrier each input and each disturbance enters first."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.barriers.chain import Chain
from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.control_affine import ControlAffineModel

_NUM_SAMPLES = 8
_SEARCHED_BEYOND = 2  # How many more derivatives an error message looks at.


def check_relative_degree(
    model: ControlAffineModel, chain: Chain, constants: Sequence[float]
) -> None:
    """Checks that the input enters the last level first (R2).

    The disturbance must come no earlier, unless the chain is robust (E8).

    Args:
        model: The plant.
        chain: phi^0, ..., phi^(r-1).
        constants: The values of the chain's constants.

    Raises:
        ModelError: The input enters earlier or later, or the disturbance earlier.
    """
    r = chain.formula.order
    inputs, disturbances = _relative_degrees(model, chain, constants)
    first = inputs.min(initial=np.inf)
    first_disturbance = disturbances.min(initial=np.inf)
    if first < r:
        raise ModelError(
            f"input {inputs.argmin()} enters derivative {first:.0f} of h, so its"
            f" relative degree is {first:.0f}, not {r}: give {_gains(first)}"
        )
    if first_disturbance < r and not chain.formula.robust:
        channel = int(disturbances.argmin())
        raise ModelError(
            f"disturbance {channel} (on {_disturbed(model, channel)}) enters derivative"
            f" {first_disturbance:.0f} of h, but the inputs enter none before {r}, so"
            " the lower derivatives are not known (R2): leave that disturbance out,"
            " choose an h that it enters no earlier than the input, or take"
            " barrier.robust_to(bound)"
        )
    if np.isinf(first):
        raise ModelError(_explain_higher_degree(model, chain, constants))


def _explain_higher_degree(
    model: ControlAffineModel, chain: Chain, constants: Sequence[float]
) -> str:
    """Returns the message for a barrier whose first r derivatives no input enters."""
    r, k = chain.formula.order, len(chain.formula.parameters)
    searched = max(r, min(r + _SEARCHED_BEYOND, model.num_states))
    plain = chain.formula._replace(order=searched, robust=False, class_k=None)
    further = Chain.of(plain)
    parameters = constants[len(constants) - k :]
    inputs, _ = _relative_degrees(model, further, [*np.ones(searched), *parameters])
    degree = inputs.min(initial=np.inf)
    if np.isinf(degree):
        return (
            f"no input enters a derivative of h up to order {searched}: choose an h of"
            f" states that the inputs of {model.name} move"
        )
    return (
        f"no input enters derivative {r} of h, its relative degree is {degree:.0f}:"
        f" give {_gains(degree)}"
    )


def _relative_degrees(
    model: ControlAffineModel, chain: Chain, constants: Sequence[float]
) -> tuple[Array, Array]:
    """Returns which derivative of h each input and each disturbance enters first.

    Shapes (m,) and (q,); infinite for a channel that enters none of them.
    """
    entered = _entered(model, chain, constants)
    degrees = np.where(entered.any(axis=0), entered.argmax(axis=0) + 1.0, np.inf)
    return degrees[: model.num_inputs], degrees[model.num_inputs :]


def _entered(
    model: ControlAffineModel,
    chain: Chain,
    constants: Sequence[float],
) -> NDArray[np.bool_]:
    """Returns which channel enters the derivative of which level, (r, m + q).

    It does not where its formula is zero, or else where it is at every sample, up to
    rounding. Where no sample can be evaluated, the formula alone decides.
    """
    slopes, written, n = chain.slopes, chain.written, model.num_states
    seen = np.zeros_like(written)
    evaluated = False
    for point in _samples(n):
        if (seen == written).all():
            break
        try:
            values = np.array(slopes(*point, *constants)).reshape(-1, n)
            _, g = model.drift_and_input_matrix(np.array(point[:n]))
        except (ArithmeticError, ValueError):  # Outside the domain of h or the model.
            continue
        channels = np.hstack([g, model.disturbance_matrix])
        if np.isfinite(values).all() and np.isfinite(channels).all():
            evaluated = True
            scale = np.outer(np.abs(values).max(axis=1), np.abs(channels).sum(axis=0))
            seen |= written & (np.abs(values @ channels) > 1e-12 * scale)
    return seen if evaluated or not written.any() else written


@lru_cache
def _samples(num_states: int) -> list[tuple[float, ...]]:
    """Returns [x; t] of several magnitudes, the same ones every time."""
    generator, samples = np.random.default_rng(0), []
    for magnitude in np.geomspace(0.1, 10.0, _NUM_SAMPLES).tolist():
        state = magnitude * generator.standard_normal(num_states)
        samples.append((*state.tolist(), magnitude))
    return samples


def _gains(number: float) -> str:
    return f"{number:.0f} gain{'' if number == 1 else 's'}"


def _disturbed(model: ControlAffineModel, channel: int) -> str:
    """Returns the names of the states a disturbance channel acts on."""
    acted_on = np.flatnonzero(model.disturbance_matrix[:, channel])
    return ", ".join(model.state_names[i] for i in acted_on)
