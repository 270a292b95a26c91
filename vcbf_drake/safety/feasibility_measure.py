"""How much room the rows leave the inputs: five measures behind one interface.

Each is a function of a polytope {v : A v <= b} with the derivative (E54)

    d(value) = sum_i mu_i (db_i - da_i p_i),

and from the multipliers mu_i and the contact points p_i follow its derivatives by
state, time, estimate and error bound: see `volume_barrier`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
import math

import numpy as np

from vcbf_drake.checks import Array
from vcbf_drake.errors import EmptySetError
from vcbf_drake.safety.ellipsoid import Ellipsoid
from vcbf_drake.safety.ellipsoid_solver import InscribedEllipsoidSolver
from vcbf_drake.safety.face_volumes import MOST_DIMENSIONS, face_volumes
from vcbf_drake.safety.input_set import InputSet
from vcbf_drake.safety.inscribed_ball import inscribed_ball

# No ellipsoid or polytope thinner than this is told from an empty one.
_THINNEST = 1e-7
# How far off counts a row that no input moves and that excludes all of them.
_FARTHEST = 1e6


@dataclass(frozen=True)
class Measurement:
    """A feasibility measure of one polytope and its derivative (E54).

    Attributes:
        value: Positive when there is more room than the threshold.
        multipliers: mu_i = d(value)/db_i, at least zero, shape (n,).
        contacts: p_i, so that d(value)/da_i = -mu_i p_i, shape (n, m); matters only
            where mu_i is positive.
        ellipsoid: The set's largest ellipsoid, where the measure found it.
    """

    value: float
    multipliers: Array
    contacts: Array
    ellipsoid: Ellipsoid | None = None


class FeasibilityMeasure(ABC):
    """A measure of the inputs that barrier rows leave of an input set.

    All in normalised inputs v (see `InputSet`). With a widening kappa > 1 the input
    set is replaced by kappa times itself (E58): in the coordinates v / kappa, the same
    input set under the rows A v <= b / kappa. Rows are then felt before they cut the
    true set.

    Args:
        input_set: The inputs before any row cuts them.
        threshold: xi, the share of the bounding box's volume that must remain.
        widening: kappa.
    """

    def __init__(
        self, input_set: InputSet, threshold: float, widening: float = 1.0
    ) -> None:
        self._A, self._b = input_set.A_normalised, input_set.b_normalised
        self._threshold, self._widening = threshold, widening

    @cached_property
    def of_input_set(self) -> Measurement | None:
        """What a set measures that no row cuts; None if it is felt before that."""
        if self._widening > 1.0:
            return None
        return self(self._A[:0], self._b[:0])

    def __call__(self, A: Array, b: Array) -> Measurement:
        """Returns the measure of the input set under the rows ``A v <= b``.

        Args:
            A: The barrier rows, shape (N, m).
            b: Their right-hand sides, shape (N,).

        Raises:
            SolverError: No value could be verified.
        """
        if self._widening == 1.0:
            return self._measure(A, b)
        found = self._measure(A, b / self._widening)
        return Measurement(
            found.value,
            found.multipliers / self._widening,
            found.contacts * self._widening,
        )

    @abstractmethod
    def _measure(self, A: Array, b: Array) -> Measurement:
        """The measure without widening."""


class _OfEllipsoid(FeasibilityMeasure):
    """A function of l = log det B of the largest ellipsoid (E20).

    An empty set counts as a ball that is too small to be told from one.
    """

    def __init__(
        self, input_set: InputSet, threshold: float, widening: float = 1.0
    ) -> None:
        super().__init__(input_set, threshold, widening)
        self._solver = InscribedEllipsoidSolver(input_set)

    @abstractmethod
    def _of_log_det(self, log_det: float) -> tuple[float, float]:
        """The value at l, and its derivative by l."""

    def _measure(self, A: Array, b: Array) -> Measurement:
        contacts = np.zeros(A.shape)
        try:
            ellipsoid = self._solver.solve(A, b)
        except EmptySetError:
            value, _ = self._of_log_det(A.shape[1] * math.log(_THINNEST))
            return Measurement(value, np.zeros(len(b)), contacts)
        value, slope = self._of_log_det(ellipsoid.log_det)
        multipliers = slope * ellipsoid.multipliers[len(self._b) :]
        for i in multipliers.nonzero()[0].tolist():
            q = ellipsoid.shape @ A[i]
            contacts[i] = ellipsoid.center + ellipsoid.shape @ q / math.sqrt(q @ q)
        return Measurement(value, multipliers, contacts, ellipsoid)


class EllipsoidVolume(_OfEllipsoid):
    """det B - xi, the paper's (E21)."""

    def _of_log_det(self, log_det: float) -> tuple[float, float]:
        determinant = math.exp(log_det)
        return determinant - self._threshold, determinant


class LogVolume(_OfEllipsoid):
    """log(det B / xi) (E55)."""

    def _of_log_det(self, log_det: float) -> tuple[float, float]:
        return log_det - math.log(self._threshold), 1.0


class RootVolume(_OfEllipsoid):
    """(det B)^(1/m) - xi^(1/m) (E55), concave in b."""

    def _of_log_det(self, log_det: float) -> tuple[float, float]:
        m = self._A.shape[1]
        root = math.exp(log_det / m)
        return root - self._threshold ** (1.0 / m), root / m


class PolytopeVolume(FeasibilityMeasure):
    """The volume itself, as a share of the bounding box's, minus xi (E56).

    Raises:
        ValueError: There are more than three inputs.
    """

    def __init__(
        self, input_set: InputSet, threshold: float, widening: float = 1.0
    ) -> None:
        super().__init__(input_set, threshold, widening)
        m = input_set.num_inputs
        if m > MOST_DIMENSIONS:
            raise ValueError(
                f"polytope_volume: at most {MOST_DIMENSIONS} inputs, not {m}"
            )

    def _measure(self, A: Array, b: Array) -> Measurement:
        k, m = self._A.shape
        volume, faces, centroids = face_volumes(
            np.concatenate([self._A, A]), np.concatenate([self._b, b])
        )
        return Measurement(
            volume / 2.0**m - self._threshold, faces[k:] / 2.0**m, centroids[k:]
        )


class Inradius(FeasibilityMeasure):
    """The signed Chebyshev radius minus xi^(1/m), of an empty set too (E57)."""

    def _measure(self, A: Array, b: Array) -> Measurement:
        k, m = self._A.shape
        ball = inscribed_ball(
            np.concatenate([self._A, A]), np.concatenate([self._b, b])
        )
        return Measurement(
            max(ball.radius, -_FARTHEST) - self._threshold ** (1.0 / m),
            ball.multipliers[k:],
            ball.contacts[k:],
        )


MEASURES: dict[str, type[FeasibilityMeasure]] = {
    "volume": EllipsoidVolume,
    "log_volume": LogVolume,
    "root_volume": RootVolume,
    "polytope_volume": PolytopeVolume,
    "inradius": Inradius,
}
