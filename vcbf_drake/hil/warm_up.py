"""warm_up: what would make the first ticks late, done before they come."""

from __future__ import annotations

import numpy as np

from vcbf_drake.safety import (
    chebyshev_ball,
    emptiness_certificate,
    inscribed_ellipsoid,
)
from vcbf_drake.safety.nearest_point import nearest_point


def warm_up(num_inputs: int) -> None:
    """Solves one problem of every kind that a filter solves.

    The first one of a kind loads its solver, which takes up to half a second: a vehicle
    would have fallen back by then.

    Args:
        num_inputs: m.
    """
    m = num_inputs
    A = np.concatenate([np.eye(m), -np.eye(m), np.full((1, m), m**-0.5)])
    b = np.append(np.ones(2 * m), 0.1)
    nearest_point(A, b, np.full(m, 2.0))
    inscribed_ellipsoid(A, b)
    chebyshev_ball(A, b)
    emptiness_certificate(A, -b)
