"""How far a point can be from the optimum of a convex program, without a solver.

For f convex, and -grad f(x) = G'y - r with y >= 0, every z with ``G z <= h`` has
f(z) >= f(x) + grad f(x)'(z - x) >= f(x) - y'(h - G x) - |r|'|z - x|. By Carathéodory
the multipliers y need as many rows as there are variables, at most, and by
complementary slackness these touch x: so every choice of touching rows is tried.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import combinations, islice

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.checks import Array

# A row touches a point that is this near to it. Rows at narrow angles leave a point
# room to be away from where they meet.
_TOUCHING = (1e-6, 1e-3, np.inf)
# No more choices of rows are tried, with floats and with rationals. Five rows of 25 are
# 53 130; a bound by any choice is one, but the best may be by the last.
_MOST_CHOICES = 100_000, 20_000


def suboptimality(
    gradient: Array, G: Array, h: Array, point: Array, reach: Array, enough: float
) -> float:
    """Returns an upper bound of f(point) - f(z) over all z with ``G z <= h``.

    Args:
        gradient: grad f at the point, shape (d,).
        G: Rows, about of unit length, shape (n, d).
        h: Their right-hand sides, shape (n,).
        point: Shape (d,).
        reach: No z is further from the point than this, in each entry, shape (d,).
        enough: A bound below this ends the search for a better one.
    """
    slack = h - G @ point
    nearest = np.argsort(slack, kind="stable")  # The rows that matter come first.
    best = float(np.abs(gradient) @ reach)  # Without any multipliers.
    for search in (_in_floats, _in_rationals):
        for tolerance in _TOUCHING:
            if best > enough:
                touching = nearest[slack[nearest] <= tolerance]
                found = search(gradient, G, h, point, touching, reach, enough)
                best = min(best, found)
    return best


def _in_floats(
    gradient: Array,
    G: Array,
    h: Array,
    point: Array,
    touching: NDArray[np.intp],
    reach: Array,
    enough: float,
) -> float:
    best = np.inf
    for choice in islice(_choices(touching, len(point)), _MOST_CHOICES[0]):
        rows = G[choice]
        y = np.linalg.lstsq(rows.T, -gradient, rcond=None)[0]
        if y.min(initial=0.0) < -1e-9 * np.abs(y).max(initial=0.0):
            continue
        y = np.maximum(y, 0.0)
        residual = float(np.abs(gradient + y @ rows) @ reach)
        best = min(best, float(y @ (h[choice] - rows @ point)) + residual)
        if best <= enough:
            break
    return best


def _choices(touching: NDArray[np.intp], size: int) -> Iterator[list[int]]:
    """Yields all touching rows, then fewer at a time, `size` at most."""
    yield touching.tolist()
    for number in range(min(size, len(touching)), 0, -1):
        yield from map(list, combinations(touching.tolist(), number))


def _in_rationals(
    gradient: Array,
    G: Array,
    h: Array,
    point: Array,
    touching: NDArray[np.intp],
    reach: Array,
    enough: float,
) -> float:
    """The same without rounding: between nearly parallel rows y is very large."""
    best, x, g = np.inf, rational(point), rational(gradient)
    for choice in islice(_choices(touching, len(point)), _MOST_CHOICES[1]):
        if not 0 < len(choice) <= len(point):
            continue
        rows = [rational(G[i]) for i in choice]
        gram = [[dot(a, b) for b in rows] for a in rows]
        y = solve_exactly(gram, [-dot(row, g) for row in rows])
        if y is None or min(y) < 0:
            continue
        columns = zip(*rows, strict=True)
        residual = [gi + dot(column, y) for gi, column in zip(g, columns, strict=True)]
        slack = [
            Fraction(float(h[i])) - dot(row, x)
            for i, row in zip(choice, rows, strict=True)
        ]
        size = float(np.abs([float(each) for each in residual]) @ reach)
        best = min(best, float(dot(y, slack)) + size)
        if best <= enough:
            break
    return best


Rational = Sequence[Fraction]


def rational(values: Array) -> Rational:
    """Returns the numbers that floats are, without rounding."""
    return [Fraction(float(value)) for value in values]


def dot(a: Rational, b: Rational) -> Fraction:
    """Returns a'b."""
    return sum((x * y for x, y in zip(a, b, strict=True)), Fraction(0))


def solve_exactly(matrix: Sequence[Rational], right: Rational) -> Rational | None:
    """Solves a linear system in rationals; None for a singular matrix.

    By Gauss and Jordan.

    Args:
        matrix: Its rows.
        right: The right-hand side.
    """
    rows = [[*row, value] for row, value in zip(matrix, right, strict=True)]
    for i in range(len(rows)):
        pivot = next((k for k in range(i, len(rows)) if rows[k][i]), None)
        if pivot is None:
            return None
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [value / rows[i][i] for value in rows[i]]
        for k in range(len(rows)):
            if k != i and rows[k][i]:
                rows[k] = [
                    a - rows[k][i] * b for a, b in zip(rows[k], rows[i], strict=True)
                ]
    return [row[-1] for row in rows]
