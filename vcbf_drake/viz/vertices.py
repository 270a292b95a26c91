"""The corners and faces of small polytopes ``{u : A u <= b}``, by enumeration."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from vcbf_drake.checks import Array


def polytope_vertices(A: Array, b: Array) -> Array:
    """The corners of a bounded polytope: where m rows meet and the others hold.

    Meant for the few rows of a control tick: it solves every choice of m rows.

    Args:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).

    Returns:
        Shape (k, m), no corner twice; k is 0 when the set is empty.
    """
    rows, inputs = A.shape
    choices = np.array(list(combinations(range(rows), inputs)))
    matrices = A[choices]
    scale = np.prod(np.linalg.norm(matrices, axis=2), axis=1)
    meeting = np.abs(np.linalg.det(matrices)) > 1e-10 * scale
    right = b[choices[meeting]][:, :, None]
    points = np.linalg.solve(matrices[meeting], right)[:, :, 0]
    reach = np.abs(b) + np.abs(points) @ np.abs(A).T
    inside = np.all(points @ A.T <= b + 1e-9 * reach, axis=1)
    return _distinct(points[inside])


def polygon(points: Array) -> Array:
    """The corners of the convex hull of points in the plane, in order around it.

    Args:
        points: Shape (k, 2).

    Returns:
        Shape (j, 2), counter-clockwise.
    """
    order = points[np.lexsort(points.T[::-1])]
    if len(order) < 3:
        return order
    lower, upper = _chain(order), _chain(order[::-1])
    return np.array(lower[:-1] + upper[:-1])


def polytope_faces(A: Array, b: Array, corners: Array) -> list[tuple[int, Array]]:
    """The faces of a polytope in space.

    Args:
        A: The rows, shape (n, 3).
        b: The right-hand sides, shape (n,).
        corners: Its corners, shape (k, 3).

    Returns:
        The row and the corners in order, shape (j, 3), of every face.
    """
    faces = []
    gap = np.abs(corners @ A.T - b)
    touching = gap <= 1e-7 * (np.abs(b) + np.abs(corners) @ np.abs(A).T)
    for row, normal in enumerate(A):
        face = corners[touching[:, row]]
        if len(face) < 3:
            continue
        across = np.linalg.svd(normal[None])[2][1:]
        x, y = across @ (face - face.mean(axis=0)).T
        faces.append((row, face[np.argsort(np.arctan2(y, x))]))
    return faces


def _chain(points: Array) -> list[Array]:
    """The part of a hull from the first point to the last; it turns left all along."""
    chain: list[Array] = []
    for point in points:
        while len(chain) > 1 and _turn(chain[-2], chain[-1], point) <= 0.0:
            chain.pop()
        chain.append(point)
    return chain


def _turn(first: Array, second: Array, third: Array) -> float:
    """Twice the signed area of a triangle, positive when it turns left."""
    (a, b), (c, d) = second - first, third - first
    return float(a * d - b * c)


def _distinct(points: Array) -> Array:
    if not len(points):
        return points
    size = np.maximum(np.abs(points).max(axis=0), 1e-300)
    keys = np.round(points / size, 9)
    return points[np.unique(keys, axis=0, return_index=True)[1]]
