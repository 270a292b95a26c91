"""Coordinates in which a moving obstacle is at rest and along the axes."""

from __future__ import annotations

from dataclasses import dataclass

from pydrake.symbolic import Expression

from vcbf_drake.barriers.moving_point import MovingPoint
from vcbf_drake.checks import Array
from vcbf_drake.model.compiled import Expressions


@dataclass(frozen=True)
class LocalFrame:
    """The coordinates z = M (p - c(t)) of a position p, as parameters of a barrier.

    They are linear in p and t, z = M p - M c - M v t, with M c and M v computed
    beforehand: that keeps the rows' expressions short.

    Attributes:
        center: c(t) = c + v t, in k dimensions.
        matrix: M, shape (k, k); None for the identity.
    """

    center: MovingPoint
    matrix: Array | None = None

    @property
    def parameters(self) -> list[float]:
        """The numbers of M c, of M v if it moves, and of M if there is one."""
        c, v, M = self.center.start, self.center.velocity, self.matrix
        return [
            *(c if M is None else M @ c),
            *((v if M is None else M @ v) if self.center.moves else ()),
            *(() if M is None else M.flat),
        ]

    def coordinates(
        self, position: Expressions, t: Expression, p: Expressions
    ) -> tuple[Expressions, Expressions]:
        """Returns the symbolic z, and what follows `parameters` in p.

        Args:
            position: The symbolic position, shape (k,).
            t: The symbolic time.
            p: A barrier's symbolic parameters, which begin with `parameters`.
        """
        k = self.center.size
        origin, p = p[:k], p[k:]
        if self.center.moves:
            origin, p = origin + p[:k] * t, p[k:]
        if self.matrix is None:
            return position - origin, p
        return p[: k * k].reshape(k, k) @ position - origin, p[k * k :]
