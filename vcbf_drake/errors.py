"""The errors this package raises; each carries the data that failed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vcbf_drake.checks import Array


class VcbfError(Exception):
    """Base of every error this package raises on purpose."""


class EmptySetError(VcbfError):
    """No point satisfies ``A u <= b``.

    Attributes:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
        inradius: The signed Chebyshev radius, negative (in units of u), or that of
            the rows in conflict alone, which is no less.
        conflict: Indices of rows that exclude each other, where they are known.
    """

    def __init__(
        self, A: Array, b: Array, inradius: float, conflict: Sequence[int] = ()
    ) -> None:
        super().__init__(
            f"the set {{u : A u <= b}} is empty: its signed Chebyshev radius is"
            f" {inradius:.3g}"
        )
        self.A, self.b, self.inradius = A, b, inradius
        self.conflict = tuple(conflict)


class UnboundedSetError(VcbfError):
    """The set ``A u <= b`` contains a ray, so it has no largest ellipsoid.

    Attributes:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
        direction: A direction in which the set never ends, shape (m,).
    """

    def __init__(self, A: Array, b: Array, direction: Array) -> None:
        super().__init__(
            "the set {u : A u <= b} is unbounded, for example along"
            f" {np.array2string(direction, precision=3)}"
        )
        self.A, self.b, self.direction = A, b, direction


class SolverError(VcbfError):
    """A solver returned nothing that could be verified.

    Attributes:
        A: The rows of the problem, shape (n, m).
        b: The right-hand sides, shape (n,).
        details: What the solver said.
    """

    def __init__(self, message: str, A: Array, b: Array, details: str = "") -> None:
        super().__init__(f"{message} ({details})" if details else message)
        self.A, self.b, self.details = A, b, details


class ModelError(VcbfError):
    """A system, barrier or disturbance does not meet what the method needs."""


class ScenarioError(VcbfError):
    """A scenario cannot be loaded: one line with file, key, value, what is allowed.

    The line is printable, whatever the file holds: other characters are escaped.
    """

    def __init__(self, message: str) -> None:
        super().__init__("".join(map(_printable, message)))


def _printable(character: str) -> str:
    return character if character.isprintable() else ascii(character)[1:-1]
