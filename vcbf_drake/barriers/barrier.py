"""High-order control barrier functions, and smooth minima and maxima of these."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import copy
from dataclasses import dataclass
from numbers import Real
from typing import Any, Protocol, TypeAlias, TypeVar

import numpy as np
from pydrake.symbolic import Expression

from vcbf_drake.checks import Array, check_parameter, finite_vector, require
from vcbf_drake.model.formulas import Expressions
from vcbf_drake.typed import check_type, typed

ClassK: TypeAlias = Callable[[Any], Any]
BarrierFunction: TypeAlias = Callable[
    [Expressions, Expression, Expressions], Expression
]


_Function = TypeVar("_Function", bound=Callable[..., Any])


def arithmetic(function: _Function) -> _Function:
    """Marks a barrier's function that uses only +, -, *, / and **.

    Such a function is read without pydrake's expressions, whose trees repeat every
    common subexpression.
    """
    function.arithmetic = True  # type: ignore[attr-defined]
    return function


def is_arithmetic(function: Callable[..., Any]) -> bool:
    """Whether a function is marked as `arithmetic`."""
    return getattr(function, "arithmetic", False)


@dataclass(frozen=True)
class EarlyDisturbance:
    """The bound of a disturbance that enters h before the input does (E8).

    Attributes:
        bound: delta1, the bound of its norm [m/s^2].
        smoothing: The length that smooths the roots of (E8), in units of E' grad h.
    """

    bound: float
    smoothing: float


class Changes(Protocol):
    """The source of a barrier's parameters at every tick."""

    def parameters_at(
        self, t: float, obstacles: Array | None
    ) -> tuple[float, ...] | None:
        """Returns the parameters at a time [s], given the obstacles perceived there.

        None stands for an empty slot.
        """


class Barrier:
    """The constraint h(x, t) >= 0 and how hard it is enforced (E3), (E4).

    Its row (E5) in the input u is ``-L_g L_f^(r-1) h u <= K' eta + L_f^r h``, with
    the relative degree r the number of gains. Write obstacle positions and the like as
    parameters: barriers that differ in gains and parameters only compile once.

    Attributes:
        function: ``function(x, t, p)`` returns h as one symbolic expression, from the
            state x (n,), the time t [s] and the parameters p (k,), all symbolic too;
            write it with NumPy.
        gains: K of (E4), (k_1, ..., k_r), shape (r,) [1/s, ..., 1/s^r].
        decay_rates: The lambda_i of (E4), shape (r,) [1/s]; the largest comes first,
            which makes the sets S^k of (E3) as large as they can be (R21).
        parameters: The values of p, shape (k,).
        name: Its name in error messages and logs.
        of_position: None if `function` takes the state x; k if it takes the first k
            coordinates of the plant's position instead.
        early_disturbance: The arguments of `robust_to`; None without it.
        class_k: The function given to `with_class_k`; None for lambda_r phi.
        changes: The source of new parameters at every tick, for which `parameters` is
            an example; None for constant parameters.

    Raises:
        ValueError: A number is not finite, there is no gain, or a decay rate is not
            real and positive.
    """

    def __init__(
        self,
        function: BarrierFunction,
        gains: Sequence[float] | Array,
        parameters: Sequence[float] | Array = (),
        name: str = "barrier",
        *,
        of_position: int | None = None,
    ) -> None:
        check_type("name", name, str)
        rule = "a function of x, t and p"
        require(callable(function), f"function of barrier '{name}'", function, rule)
        check_type("of_position", of_position, int | None)
        self.function = function
        self.gains = finite_vector(gains, f"gains of barrier '{name}'")
        self.decay_rates = decay_rates(self.gains, name)
        self.parameters = finite_vector(parameters, f"parameters of barrier '{name}'")
        self.name = name
        self.of_position = of_position
        self.early_disturbance: EarlyDisturbance | None = None
        self.class_k: ClassK | None = None
        self.changes: Changes | None = None

    @typed
    def robust_to(self, bound: float, smoothing: float = 0.01) -> Barrier:
        """Returns this barrier, robust to a disturbance that enters before the input.

        Every level of its chain subtracts the disturbance's worst case (E8), so that
        only the last needs an observer. It keeps a larger distance than the plain
        barrier.

        Args:
            bound: delta1, the bound of the disturbance's norm [m/s^2].
            smoothing: The length that keeps the norms differentiable, in units of E'
                grad h.

        Raises:
            ValueError: The bound is negative, the smoothing not positive.
        """
        check_parameter("robust_to: bound", bound, zero_allowed=True)
        check_parameter("robust_to: smoothing", smoothing)
        robust = copy.copy(self)
        robust.early_disturbance = EarlyDisturbance(bound, smoothing)
        return robust

    def with_class_k(self, class_k: ClassK) -> Barrier:
        """Returns this barrier with another function in place of lambda_r phi (E10).

        Its row is d/dt phi^(r-1) >= -class_k(phi^(r-1)); the faster decay rates still
        make the levels before. A cube leaves the robot free far from the boundary and
        slows it down near it.

        Args:
            class_k: An extended class-K function, of a number or a symbol: 0 at 0, and
                increasing. It must be smooth and written with NumPy.

        Raises:
            ValueError: It is not 0 at 0, or its value or slope shows that it does not
                increase, at one of 400 points of either sign from 0.001 to 1000.
        """
        _check_class_k(class_k, self.name)
        changed = copy.copy(self)
        changed.class_k = class_k
        return changed

    @property
    def relative_degree(self) -> int:
        """The number r of derivatives of h after which the input appears."""
        return len(self.gains)

    @property
    def constants(self) -> tuple[float, ...]:
        """The constants of its chain, beside x and t: see `Chain.constants`."""
        early = self.early_disturbance
        worst = () if early is None else (early.bound, early.smoothing)
        return (*self.decay_rates.tolist(), *worst, *self.parameters.tolist())


def _check_class_k(class_k: ClassK, name: str) -> None:
    """Checks values at 400 points and slopes there, by a neighbour of each."""
    require(callable(class_k), f"barrier '{name}': class_k", class_k, "a function")
    positive = np.geomspace(1e-3, 1e3, 200)
    positive = np.ravel([positive, positive * (1.0 + 1e-6)], order="F")
    points = np.concatenate([-positive[::-1], [0.0], positive])
    with np.errstate(all="ignore"):
        found = [class_k(point) for point in points]
    is_number = np.array([isinstance(v, Real) for v in found])
    values = np.array([float(v) if isinstance(v, Real) else np.nan for v in found])
    # It may overflow far away, or level off.
    near, finite = np.abs(points) < 1.0, np.isfinite(values)
    wrong = ~is_number | (near & ~finite)
    wrong |= (points == 0.0) & (np.abs(values) > 1e-12)
    rule = f"barrier '{name}': class_k must be 0 at 0 and increase"
    if wrong.any():
        i = int(wrong.argmax())
        raise ValueError(f"{rule}; at {points[i]:.7g} it is {found[i]!r}")
    points, values, near = points[finite], values[finite], near[finite]
    steps, rounding = np.diff(values), 1e-12 * np.abs(values[1:])
    falls = (steps < -rounding) | (near[1:] & (steps <= 0.0))
    if falls.any():
        i = int(falls.argmax())
        raise ValueError(
            f"{rule}; at {points[i]:.7g} it is {values[i]:g}, at {points[i + 1]:.7g}"
            f" {values[i + 1]:g}"
        )


def decay_rates(gains: Array, name: str) -> Array:
    """Returns lambda_1 >= ... >= lambda_r, where -lambda_i are the roots of (E4).

    Raises:
        ValueError: There is no gain, or a decay rate is not real and positive.
    """
    degree = len(gains)
    if degree == 0:
        raise ValueError(f"barrier '{name}': give at least one gain")
    rates = -np.roots([1.0, *gains])
    # A double root comes back as a pair this far from the real axis.
    rounding = 10.0 * np.finfo(float).eps ** (1.0 / degree) * np.abs(rates).max()
    if np.abs(rates.imag).max() > rounding or rates.real.min() <= 0.0:
        raise ValueError(
            f"barrier '{name}': gains {gains.tolist()} give decay rates"
            f" {np.array2string(rates, precision=4)}; they must be real and positive"
            " (for two gains: k1 > 0, 0 < k2 <= k1^2 / 4)"
        )
    ordered = np.sort(rates.real)[::-1]
    ordered.flags.writeable = False
    return ordered


def all_of(barriers: Sequence[Barrier], smoothing: float, name: str = "all") -> Barrier:
    """Returns the smooth minimum of barriers, positive only where all are (E11).

    It keeps clear of a union of obstacles by one row. It is below each h: two barriers
    differ from the exact minimum by at most half the smoothing, and each doubling of
    their number adds another half.

    Args:
        barriers: At least one, of the same gains; without parameters that change.
        smoothing: The length e over which two of them blend, in the unit of h.
        name: Its name in error messages and logs.

    Raises:
        ValueError: There is no barrier, gains differ, or the smoothing is not positive.
    """
    return _combined(barriers, smoothing, name, smooth_minimum)


def any_of(barriers: Sequence[Barrier], smoothing: float, name: str = "any") -> Barrier:
    """Returns the smooth maximum of barriers, positive only where one of them is (E12).

    It keeps inside a union of rooms, or outside a polygon. It is never above the
    greatest h: for two barriers it is below by at most half the smoothing, and each
    doubling of their number adds another half. Arguments and errors as of `all_of`.
    """
    return _combined(barriers, smoothing, name, smooth_maximum)


def smooth_minimum(a: Any, b: Any, smoothing: Any) -> Any:
    """Returns a smooth bound of min(a, b) from below (E11)."""
    return (a + b - ((a - b) ** 2 + smoothing**2) ** 0.5) / 2


def smooth_maximum(a: Any, b: Any, smoothing: Any) -> Any:
    """Returns a smooth bound of max(a, b) from below (E12)."""
    return (a + b + ((a - b) ** 2 + smoothing**2) ** 0.5 - smoothing) / 2


def in_pairs(values: Sequence[Any], smoothing: Any, combine: Any) -> Any:
    """Combines values in pairs, then the results, which keeps the error small."""
    values = list(values)
    while len(values) > 1:
        pairs = [values[i : i + 2] for i in range(0, len(values), 2)]
        values = [
            combine(*pair, smoothing) if len(pair) == 2 else pair[0] for pair in pairs
        ]
    return values[0]


def _combined(
    barriers: Sequence[Barrier], smoothing: float, name: str, combine: Any
) -> Barrier:
    some = isinstance(barriers, Sequence) and len(barriers) > 0
    require(some, f"{name}: barriers", barriers, "a list of one at least")
    check_parameter(f"{name}: smoothing", smoothing)
    for each in barriers:
        rule = "a Barrier, as shape.barrier(gains) makes it"
        require(isinstance(each, Barrier), f"{name}: barriers", each, rule)
    first = barriers[0]
    for each in barriers:
        fixed = each.changes is None and each.early_disturbance is None
        rule = "a Barrier as its shape makes it, of fixed parameters"
        require(fixed and each.class_k is None, f"{name}: barrier", each.name, rule)
        rule = f"{first.gains.tolist()}, those of '{first.name}'"
        same = np.array_equal(each.gains, first.gains)
        require(same, f"{name}: gains of '{each.name}'", each.gains.tolist(), rule)
        rule = "given to all of them, or to none"
        alike = each.of_position == first.of_position
        require(alike, f"{name}: position of '{each.name}'", each.of_position, rule)
    functions = [each.function for each in barriers]
    ends = np.cumsum([len(each.parameters) for each in barriers]).tolist()
    spans = [slice(a, b) for a, b in zip([0, *ends], ends, strict=False)]

    def h(x: Expressions, t: Expression, p: Expressions) -> Expression:
        values = [f(x, t, p[span]) for f, span in zip(functions, spans, strict=True)]
        return in_pairs(values, p[-1], combine)

    parameters = [*np.concatenate([each.parameters for each in barriers]), smoothing]
    return Barrier(h, first.gains, parameters, name, of_position=first.of_position)
