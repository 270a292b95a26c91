"""The rows that barriers put on the input at one state and time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.checks import Array


@dataclass(frozen=True)
class BarrierRows:
    """N rows ``A u <= b + w d`` and their derivatives by xbar = [x; t], read-only.

    Few rows touch the ellipsoid at a time, and most of a row's numbers are its
    derivatives: they are evaluated when they are asked for.

    Rows of a barrier are (E7), (E17); rows of a limit on the input have w = 0 and no
    value. A row is not finite where its barrier is singular.

    Attributes:
        value: h, shape (N,); nan for a limit.
        chain: phi^0, ..., phi^(r-1) of (E3) for each row, shapes (r_i,); empty for a
            limit.
        A: -L_g L_f^(r-1) h, shape (N, m).
        b: K' eta + L_f^r h, shape (N,).
        w: E' grad_x L_f^(r-1) h, shape (N, q).
        num_states: n.
        gradients: ``gradients(rows)`` returns the derivatives of the entries [A, b, w]
            of the rows with these indices, shape (len(rows), m + 1 + q, n + 1).
    """

    value: Array
    chain: tuple[Array, ...]
    A: Array
    b: Array
    w: Array
    num_states: int
    gradients: Callable[[Sequence[int]], Array]

    @cached_property
    def _all_gradients(self) -> Array:
        return self.gradients(range(len(self.b)))

    @property
    def A_gradient(self) -> Array:
        """The derivatives of A, shape (N, m, n + 1)."""
        return self._all_gradients[:, : self.A.shape[1]]

    @property
    def b_gradient(self) -> Array:
        """The derivatives of b, shape (N, n + 1)."""
        return self._all_gradients[:, self.A.shape[1]]

    @property
    def w_gradient(self) -> Array:
        """The derivatives of w, shape (N, q, n + 1)."""
        return self._all_gradients[:, self.A.shape[1] + 1 :]

    def authority(self, scale: Array) -> Array:
        """Returns how far the input moves each row, |A diag(scale)|, shape (N,).

        Args:
            scale: What counts as one of each input, shape (m,).
        """
        authority: Array = np.linalg.norm(self.A * scale, axis=1)
        return authority

    def rows_without_authority(
        self, scale: Array, tolerance: float = 1e-6
    ) -> NDArray[np.bool_]:
        """Returns which rows no input can move at this state (R33), shape (N,).

        Args:
            scale: What counts as one of each input, shape (m,).
            tolerance: The least authority that counts, in units of b.
        """
        return self.authority(scale) <= tolerance


class RowsAlong(NamedTuple):
    """The rows of `BarrierRows` along a trajectory of T states.

    Attributes:
        value: h, shape (T, N).
        chain: phi^0, phi^1, ..., shape (T, N, r + 1) with the largest r; nan beyond a
            row's own phi^(r-1).
        A: Shape (T, N, m).
        b: Shape (T, N).
        w: Shape (T, N, q).
    """

    value: Array
    chain: Array
    A: Array
    b: Array
    w: Array
