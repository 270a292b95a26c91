"""Rows of unit length, which measure a violation as a distance."""

from __future__ import annotations

import numpy as np

from vcbf_drake.checks import Array

# A row shorter than this, which moves by no more over all normalised inputs, is blank.
BLANK = 1e-12


def of_unit_length(A: Array, b: Array) -> tuple[Array, Array, Array]:
    """Returns rows and right-hand sides over the rows' lengths, and the lengths (n,).

    Of blank rows, which no input moves, zeros are left, and what stands to their right.

    Args:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
    """
    length: Array = np.sqrt(np.einsum("ij,ij->i", A, A))
    is_blank = length <= BLANK
    if not is_blank.any():
        return A / length[:, None], b / length, length
    length[is_blank] = 1.0
    return np.where(is_blank, 0.0, A.T / length).T, b / length, length
