"""What everybody solves: a point mass with drag in space, thrust limits, three spheres.

Small enough that its rows are written by hand for those who cannot derive them, in
plain arithmetic that NumPy arrays, complex numbers and JAX's arrays all pass through.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from vcbf_drake.checks import Array

DRAG = 0.1  # [1/s]
LIMIT = 1.0  # The largest acceleration along each axis [m/s^2].
CENTERS = np.array([[1.5, 0.3, 0.2], [2.6, -0.9, -0.3], [2.4, 0.9, -0.8]])  # [m]
RADII = np.array([0.5, 0.6, 0.5])  # [m]
RATES = (1.0, 3.0)  # Decay rates of the barriers [1/s].
GAINS = (RATES[0] + RATES[1], RATES[0] * RATES[1])  # K of (E4).
# xi of (E49) and lambda_Vv [1/s]: cautious, so that the volume row acts often.
THRESHOLD, VOLUME_GAIN = 0.1, 0.5

NUM_STATES, NUM_INPUTS = 6, 3

A_PLANT = np.block(
    [[np.zeros((3, 3)), np.eye(3)], [np.zeros((3, 3)), -DRAG * np.eye(3)]]
)
B_PLANT = np.vstack([np.zeros((3, 3)), np.eye(3)])
BOX_A = np.vstack([np.eye(3), -np.eye(3)])
BOX_B = np.full(6, LIMIT)


@dataclass(frozen=True)
class Instance:
    """One tick: where the point is, and what its controller wants.

    Attributes:
        state: Position [m] and velocity [m/s], shape (6,).
        reference: The controller's input, shape (3,) [m/s^2].
    """

    state: Array
    reference: Array


def barrier_rows(state: Any) -> tuple[Any, Any]:
    """Returns A (3, 3) and b (3,) of the rows A u <= b (E7) of h = |p - c|^2 - r^2.

    Args:
        state: Position and velocity, shape (6,), of any kind of number.
    """
    offset, velocity = state[:3] - CENTERS, state[3:]
    h = (offset * offset).sum(axis=1) - RADII**2
    rate = 2.0 * (offset @ velocity)
    acceleration = 2.0 * (velocity @ velocity) - DRAG * rate  # L_f^2 h
    return -2.0 * offset, GAINS[0] * rate + GAINS[1] * h + acceleration


def polytope(state: Array) -> tuple[Array, Array]:
    """Returns A (9, 3) and b (9,) of the feasible inputs: the box, then the rows."""
    A, b = barrier_rows(state)
    return np.vstack([BOX_A, A]), np.concatenate([BOX_B, b])


def volume_row(state: Array, det: float, gradient: Array) -> tuple[Array, float]:
    """Returns a (3,) and c of the row a u <= c of the volume barrier (E54).

    Args:
        state: Shape (6,).
        det: det B of the largest ellipsoid of inputs.
        gradient: Its derivative by the state, shape (6,).
    """
    known = float(gradient @ A_PLANT @ state)
    return -gradient @ B_PLANT, known + VOLUME_GAIN * (det - THRESHOLD)


def instances(count: int, seed: int = 0) -> list[Instance]:
    """Returns states in which the rows matter; some leave no feasible input.

    They cut into the box's largest ellipsoid, the ball: elsewhere there is no work.

    Args:
        count: How many.
        seed: Which.
    """
    generator = np.random.default_rng(seed)
    found: list[Instance] = []
    while len(found) < count:
        position = generator.uniform([0.0, -2.0, -1.5], [4.0, 2.0, 1.5])
        state = np.append(position, generator.normal(0.0, 0.6, 3))
        reference = generator.uniform(-1.5 * LIMIT, 1.5 * LIMIT, 3)
        A, b = barrier_rows(state)
        is_outside = (np.linalg.norm(position - CENTERS, axis=1) > RADII).all()
        if is_outside and (b < LIMIT * np.linalg.norm(A, axis=1)).any():
            found.append(Instance(state, reference))
    return found
