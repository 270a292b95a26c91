"""Lawson and Hanson's active-set iterations on a handful of rows."""

from __future__ import annotations

import numpy as np

from vcbf_drake.errors import Array


def nonnegative_multipliers(A: Array, b: Array, reference: Array) -> Array:
    """Returns the y >= 0 that minimises 1/2 |A'y|^2 - y'(A reference - b).

    The dual of the projection, by Lawson and Hanson's active-set iterations: the row
    that is violated most joins, rows that would push leave. They end after finitely
    many when the rows have a common point; a limit ends them when they have none.
    """
    violation = A @ reference - b
    tolerance = 1e-12 * (1.0 + float(np.abs(violation).max(initial=0.0)))
    y, active = np.zeros(len(b)), np.zeros(len(b), dtype=bool)
    for _ in range(3 * len(b)):
        excess = violation - A @ (y @ A)
        excess[active] = -np.inf
        worst = excess.argmax()
        if excess[worst] <= tolerance:
            break
        active[worst] = True
        target = _restricted_minimiser(A, violation, active, y)
        while target.min() < 0.0:  # Walk towards the target; drop what blocks.
            falling = active & (target <= 0.0)
            step = np.min(y[falling] / (y[falling] - target[falling]))
            y = y + step * (target - y)
            active &= ~(falling & (y <= 1e-14))
            y[~active] = 0.0
            target = _restricted_minimiser(A, violation, active, y)
        y = target
    return y


def _restricted_minimiser(A: Array, violation: Array, active: Array, y: Array) -> Array:
    """The minimiser with y = 0 off the active rows: A A'y = violation on them.

    Solved as A s = violation, A'y = s: A A' would square how nearly parallel rows are.
    When the row that joined depends on the others there is no such s. What is left of
    the violation is then a direction with A'ray = 0, along which the cost falls without
    end; the answer lies so far out on it, seen from y, that a row blocks the way.
    """
    target = np.zeros(len(violation))
    index = active.nonzero()[0]
    if len(index) == 1:
        target[index] = violation[index] / (A[index[0]] @ A[index[0]])
    elif len(index) > 1:
        rows = A[index]
        step = np.linalg.lstsq(rows, violation[index], rcond=1e-12)[0]
        ray = violation[index] - rows @ step
        if np.abs(ray).max() > 1e-9 * (1.0 + np.abs(violation[index]).max()):
            falling = ray < 0.0
            reach = (y[index][falling] / -ray[falling]).max(initial=1.0)
            target[index] = y[index] + 2.0 * reach * ray
        else:
            target[index] = np.linalg.lstsq(rows.T, step, rcond=1e-12)[0]
    return target
