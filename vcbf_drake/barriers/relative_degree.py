"""Relative degree: the first derivative of h that each input and disturbance enters."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.barriers.barrier import Barrier
from vcbf_drake.barriers.chain import Chain
from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError
from vcbf_drake.model.control_affine import ControlAffineModel

_NUM_SAMPLES = 8
_SEARCHED_BEYOND = 2  # Further derivatives that an error message considers.


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
