"""The volume of a polytope of at most three dimensions, and of each of its faces.

Lasserre's recursion: a polytope is the union of the pyramids over its faces, and a face
is a polytope of one dimension less.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.checks import Array
from vcbf_drake.errors import SolverError

# Rows whose directions differ by less than this count as parallel.
_PARALLEL = 1e-12
# Parallel rows that are nearer to each other than this are the same.
_SAME = 1e-12
MOST_DIMENSIONS = 3


def face_volumes(A: Array, b: Array) -> tuple[float, Array, Array]:
    """Returns the volume of ``{v : A v <= b}``, and its derivative by the rows (E56).

    d(volume) = sum_i mu_i (db_i - da_i p_i) with mu_i = |F_i| / |a_i|, the area of face
    i over the length of its row, and p_i the face's centroid. Rows without a face, and
    all but the first of rows given twice, have mu_i = 0; so has every row of an empty
    set.

    Args:
        A: The rows, shape (n, m) with m at most 3.
        b: The right-hand sides, shape (n,).

    Returns:
        The volume, mu of shape (n,) and p of shape (n, m).

    Raises:
        SolverError: The set is unbounded.
    """
    length = np.sqrt(np.einsum("ij,ij->i", A, A))
    live = length > 0.0
    multipliers, centroids = np.zeros(len(b)), np.zeros(A.shape)
    if (b[~live] < 0.0).any():
        return 0.0, multipliers, centroids
    normals, distance = A[live] / length[live, None], b[live] / length[live]
    with np.errstate(invalid="ignore"):  # An unbounded face.
        areas, centroids[live] = _faces(normals, distance)
    if not np.isfinite(areas).all():
        raise SolverError("the volume of an unbounded set", A, b)
    multipliers[live] = areas / length[live]
    volume, _ = _pyramids(distance, areas, centroids[live])
    return volume, multipliers, centroids


def _pyramids(distance: Array, areas: Array, centroids: Array) -> tuple[float, Array]:
    """Volume and centroid of the union of the pyramids from the origin to the faces.

    With faces that the origin lies beyond counted negatively.
    """
    m = centroids.shape[1]
    parts = distance * areas / m
    volume = float(parts.sum())
    if volume <= 0.0:
        return 0.0, np.zeros(m)
    return volume, parts @ centroids * (m / ((m + 1.0) * volume))


def _faces(normals: Array, distance: Array) -> tuple[Array, Array]:
    """Areas (n,) and centroids (n, m) of the faces under unit normals."""
    if normals.shape[1] == 1:
        return _ends(normals, distance)
    if normals.shape[1] == 2:
        return _edges(normals, distance)
    areas, centroids = np.zeros(len(distance)), np.zeros(normals.shape)
    cosine = normals @ normals.T
    gap = distance - distance[:, None] * cosine
    meets = 1.0 - np.abs(cosine) > _PARALLEL
    for i in (~_has_no_face(gap, cosine, meets)).nonzero()[0]:
        plane = np.linalg.svd(normals[i : i + 1])[2][1:]
        flat = normals[meets[i]] @ plane.T
        size = np.sqrt(1.0 - cosine[i, meets[i]] ** 2)
        flat, reach = flat / size[:, None], gap[i, meets[i]] / size
        areas[i], center = _pyramids(reach, *_faces(flat, reach))
        centroids[i] = distance[i] * normals[i] + center @ plane
    return areas, centroids


def _has_no_face(
    gap: Array, cosine: Array, meets: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Whether a parallel row leaves row i none: a nearer one, or an earlier twin.

    Args:
        gap: How far row j lies beyond row i along row j, (n, n).
        cosine: Of the angle between the two, (n, n).
        meets: Whether the two are not parallel, (n, n).
    """
    same = np.abs(gap) < _SAME
    earlier_twin = np.tri(len(gap), k=-1, dtype=bool) & (cosine > 0.0)
    blocks = ~meets & np.where(same, earlier_twin, gap < 0.0)
    return np.asarray(blocks.any(axis=1))


def _edges(normals: Array, distance: Array) -> tuple[Array, Array]:
    """Lengths and midpoints of a polygon's edges, all at once."""
    along = np.column_stack([-normals[:, 1], normals[:, 0]])
    slope = along @ normals.T  # Of row j along edge i.
    cosine = normals @ normals.T
    gap = distance - distance[:, None] * cosine
    meets = np.abs(slope) > _PARALLEL
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = gap / slope
    upper = np.where(meets & (slope > 0.0), crossing, np.inf).min(axis=1)
    lower = np.where(meets & (slope < 0.0), crossing, -np.inf).max(axis=1)
    blocked = _has_no_face(gap, cosine, meets) | (upper <= lower)
    length = np.where(blocked, 0.0, upper - lower)
    middle = np.where(length > 0.0, 0.5 * (upper + lower), 0.0)
    return length, distance[:, None] * normals + middle[:, None] * along


def _ends(normals: Array, distance: Array) -> tuple[Array, Array]:
    """The two ends of an interval, each of measure one."""
    ends = distance[:, None] * normals
    upper = int(np.where(normals[:, 0] > 0.0, distance, np.inf).argmin())
    lower = int(np.where(normals[:, 0] < 0.0, distance, np.inf).argmin())
    areas = np.zeros(len(distance))
    if distance[upper] + distance[lower] > 0.0:
        areas[[upper, lower]] = 1.0
    return areas, ends
