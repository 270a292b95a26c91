"""CPU time: pytest --benchmark-only --benchmark-timer=time.process_time."""

import numpy as np
import pytest

from vcbf_drake.safety.chebyshev import chebyshev_ball
from vcbf_drake.safety.ellipsoid import inscribed_ellipsoid
from vcbf_drake.safety.ellipsoid_solver import InscribedEllipsoidSolver
from vcbf_drake.safety.emptiness import emptiness_certificate
from vcbf_drake.safety.input_set import InputSet

# The last input, like the blimp's yaw moment, is in no row.
A = np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.3, -0.9, 0.0]])
BOX = InputSet.box(-np.ones(3), np.ones(3))


@pytest.mark.parametrize(
    "b",
    [[3.0, 5.0, 5.0], [0.3, 5.0, 5.0], [0.3, 0.5, 1.5]],
    ids=["plateau", "one row cuts", "two rows cut"],
)
def test_cut_box(benchmark, b):
    solver = InscribedEllipsoidSolver(BOX)
    benchmark(solver.solve, A, np.array(b))


def test_cut_box_without_decoupled_inputs(benchmark):
    solver = InscribedEllipsoidSolver(BOX)
    rows = A + np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.2], [0.0, 0.0, 0.3]])
    benchmark(solver.solve, rows, np.array([0.3, 0.5, 1.5]))


def test_inscribed_ellipsoid(benchmark):
    rng = np.random.default_rng(0)
    rows = np.vstack([BOX.A, rng.standard_normal((8, 3))])
    benchmark(inscribed_ellipsoid, rows, rng.uniform(0.2, 1.0, 14))


def test_chebyshev_ball(benchmark):
    benchmark(chebyshev_ball, np.vstack([BOX.A, A]), np.ones(9))


def test_emptiness_certificate(benchmark):
    rows = np.vstack([BOX.A, A, -A[:1]])
    benchmark(emptiness_certificate, rows, np.append(np.ones(9), -1.1))
