"""The faces of the paper's feasible solids."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from examples.paper.feasible_solid_figure import polytope_faces
from vcbf_drake.viz.feasible_set import polytope_vertices


@pytest.mark.parametrize("seed", range(5))
def test_faces_close_the_polytope(seed):
    rng = np.random.default_rng(seed)
    A, b = rng.normal(size=(9, 3)), rng.uniform(0.3, 1.0, 9)
    A, b = np.vstack([A, np.eye(3), -np.eye(3)]), np.append(b, np.ones(6))
    corners = polytope_vertices(A, b, -np.ones(3), np.ones(3))
    volume, edges, faces = 0.0, 0, polytope_faces(A, b, corners)
    for row, face in faces:
        np.testing.assert_allclose(face @ A[row], b[row], atol=1e-9)
        around = np.cross(face, np.roll(face, -1, axis=0)).sum(axis=0)
        volume += abs(face[0] @ around) / 6.0  # A pyramid up from the origin.
        edges += len(face)
    assert len(corners) - edges // 2 + len(faces) == 2  # Euler.
    assert volume == pytest.approx(ConvexHull(corners).volume)
