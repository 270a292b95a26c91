"""Polygonal obstacles in the plane, convex or not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import ClassVar

import numpy as np
from pydrake.symbolic import Expression

from vcbf_drake.barriers.barrier import (
    arithmetic,
    in_pairs,
    smooth_maximum,
    smooth_minimum,
)
from vcbf_drake.barriers.shapes import ShapeFunction, SmoothShape
from vcbf_drake.checks import Array, finite_array, require
from vcbf_drake.model.formulas import Expressions
from vcbf_drake.typed import NotNegative, Positive, check_fields

_Piece = list[int]  # Indices of vertices, anticlockwise.


@dataclass(frozen=True)
class PolygonObstacle(SmoothShape):
    """A polygon in the plane, or a pillar of that outline in space; convex or not.

    A position is outside a convex polygon if it is beyond one of its sides: with the
    outward unit normals n_i and the offsets o_i, the barrier is the smooth maximum
    (E12)::

        h = smooth max_i (n_i . p - o_i) - margin    [m]

    A polygon that is not convex is cut into convex pieces, whose smooth minimum (E11)
    is the barrier. `barriers` gives each piece its own, which is exact where two of
    them meet. h is smooth everywhere and conservative: outside it never exceeds the
    distance to the polygon less the margin, and inside it is negative. Relative degree
    2 for a position that forces accelerate (`Car`). Source: ours.

    Attributes:
        vertices: In order, either way round, shape (n, 2) [m].
        margin: The distance to keep from the sides [m].
        smoothing: The length over which two sides, or two pieces, blend [m].
    """

    kind: ClassVar[str] = "polygon"
    vertices: Sequence[Sequence[float]] | Array
    margin: NotNegative = 0.0
    smoothing: Positive = 0.05

    def __post_init__(self) -> None:
        check_fields(self, "polygon: ")
        rule = "at least 3 corners of 2 finite numbers each"
        corners = finite_array(self.vertices, "polygon: vertices", 2, rule)
        flat = corners.shape[1] == 2 and len(corners) >= 3
        require(flat, "polygon: vertices", self.vertices, rule)
        for i, j in combinations(range(len(corners)), 2):
            if np.array_equal(corners[i], corners[j]):
                raise ValueError(
                    f"polygon: corner {j} is corner {i} again; give it once"
                )
        crossing = _crossing_sides(corners)
        if crossing:
            raise ValueError(f"polygon: its sides {crossing[0]} and {crossing[1]} meet")

    @property
    def pieces(self) -> list[Array]:
        """The convex pieces of the polygon, anticlockwise, shapes (n_i, 2)."""
        corners = _anticlockwise(np.array(self.vertices, dtype=float))
        if _is_convex(corners):
            return [corners]
        return [corners[piece] for piece in _merged(corners, _triangles(corners))]

    def parts(self) -> dict[str, PolygonObstacle]:
        """Returns its convex pieces: each has its own barrier."""
        pieces = [replace(self, vertices=piece.tolist()) for piece in self.pieces]
        if len(pieces) == 1:
            return {"": pieces[0]}
        return {f".{i}": piece for i, piece in enumerate(pieces, start=1)}

    def formula(self) -> tuple[int, ShapeFunction, list[float]]:
        """Returns 2, h(position, t, p) with p = (sides, smoothing, margin), and p."""
        pieces = self.pieces
        ends = np.cumsum([len(piece) for piece in pieces])[:-1].tolist()

        @arithmetic
        def h(position: Expressions, t: Expression, p: Expressions) -> Expression:
            (x, y), (smoothing, margin) = position[:2], p[-2:]
            each = [
                in_pairs(
                    [a * x + b * y - c for a, b, c in sides], smoothing, smooth_maximum
                )
                for sides in np.split(p[:-2].reshape(-1, 3), ends)
            ]
            return in_pairs(each, smoothing, smooth_minimum) - margin

        sides = np.concatenate([_sides(piece) for piece in pieces])
        return 2, h, [*sides.flat, self.smoothing, self.margin]


def _sides(piece: Array) -> Array:
    """Returns n_x, n_y and n . p of every side, the normal outwards, shape (n, 3)."""
    along = np.roll(piece, -1, axis=0) - piece
    normals = np.column_stack([along[:, 1], -along[:, 0]])
    normals /= np.linalg.norm(along, axis=1)[:, None]
    return np.column_stack([normals, np.sum(normals * piece, axis=1)])


def _turn(a: Array, b: Array, c: Array) -> float:
    """Twice the area of a triangle, positive if anticlockwise."""
    (x, y), (u, v) = b - a, c - a
    return float(x * v - y * u)


def _anticlockwise(corners: Array) -> Array:
    # From a corner: far from the origin the products would round the area away.
    x, y = (corners - corners[0]).T
    area = np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    return corners if area > 0.0 else corners[::-1]


def _crossing_sides(corners: Array) -> tuple[int, int] | None:
    """Returns two sides that meet where they must not; None for a simple polygon."""
    n = len(corners)
    for i, j in combinations(range(n), 2):
        a, b = corners[i], corners[(i + 1) % n]
        c, d = corners[j], corners[(j + 1) % n]
        if j == i + 1 or (i == 0 and j == n - 1):  # Neighbours: back on themselves?
            shared, one, other = (b, a, d) if j == i + 1 else (a, b, c)
            folded = _turn(one, shared, other) == 0.0
            if folded and np.dot(one - shared, other - shared) > 0.0:
                return i, j
            continue
        if (
            _turn(a, b, c) * _turn(a, b, d) <= 0.0
            and _turn(c, d, a) * _turn(c, d, b) <= 0.0
            and np.all(
                np.maximum(np.minimum(a, b), np.minimum(c, d))
                <= np.minimum(np.maximum(a, b), np.maximum(c, d))
            )
        ):
            return i, j
    return None


def _triangles(corners: Array) -> list[_Piece]:
    """Cuts a simple, anticlockwise polygon into triangles, ear by ear."""
    left, found = list(range(len(corners))), []
    while len(left) > 3:
        for k, ear in enumerate(left):
            before, after = left[k - 1], left[(k + 1) % len(left)]
            a, b, c = corners[[before, ear, after]]
            others = [corners[i] for i in left if i not in (before, ear, after)]
            if _turn(a, b, c) > 0.0 and not any(_holds(a, b, c, p) for p in others):
                found.append([before, ear, after])
                left.pop(k)
                break
            if _turn(a, b, c) == 0.0:  # A corner on a straight side.
                left.pop(k)
                break
        else:
            raise ValueError(
                "polygon: its corners are too close together to tell apart"
            )
    return [*found, left]


def _holds(a: Array, b: Array, c: Array, p: Array) -> bool:
    return min(_turn(a, b, p), _turn(b, c, p), _turn(c, a, p)) >= 0.0


def _merged(corners: Array, pieces: list[_Piece]) -> list[_Piece]:
    """Joins neighbours as long as their union is convex (Hertel and Mehlhorn)."""
    pieces = list(pieces)
    while True:
        for first, second in combinations(pieces, 2):
            joined = _joined(first, second)
            if joined and _is_convex(corners[joined]):
                pieces = [p for p in pieces if p is not first and p is not second]
                pieces.append(joined)
                break
        else:
            return pieces


def _joined(first: _Piece, second: _Piece) -> _Piece | None:
    """Two pieces without the side they share; None if they share none."""
    for i, start in enumerate(first):
        end = first[(i + 1) % len(first)]
        for j, other in enumerate(second):
            if other == end and second[(j + 1) % len(second)] == start:
                around = second[j + 1 :] + second[: j + 1]  # From start to end.
                return first[: i + 1] + around[1:-1] + first[i + 1 :]
    return None


def _is_convex(corners: Array) -> bool:
    before, after = np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0)
    return all(
        _turn(a, b, c) >= 0.0 for a, b, c in zip(before, corners, after, strict=True)
    )
