"""Intervals with outward rounding: arithmetic whose results are certain.

What an operation returns encloses all that real numbers inside its arguments can give.
Where there is no finite enclosure (a division by an interval around 0, an overflow) it
raises what Python's floats raise there, an ArithmeticError or a ValueError.
"""

from __future__ import annotations

import ast
from collections.abc import Callable
from functools import lru_cache
import inspect
import math
from math import inf, nextafter
from typing import TypeAlias

from vcbf_drake.errors import ModelError
from vcbf_drake.model.formulas import CompiledFunction, function_of

Number: TypeAlias = "Interval | float"
IntervalFunction: TypeAlias = Callable[..., list[Number]]

# The C library's functions err by less than this many units in the last place.
_LIBRARY_ERROR = 4.0
# Where the periods of larger angles are not told apart, and how well they are below.
_LARGEST_ANGLE = 1e6
_ANGLE_ERROR = 1e-9


class Interval:
    """The real numbers from `low` to `high`.

    Attributes:
        low: The least of them.
        high: The greatest of them.
    """

    __slots__ = ("high", "low")

    def __init__(self, low: float, high: float) -> None:
        """Takes both ends as they are.

        Raises:
            OverflowError: One of them is not finite.
        """
        if not high - low < inf:
            raise OverflowError(f"[{low}, {high}] does not hold finite numbers only")
        self.low = low
        self.high = high

    def __repr__(self) -> str:
        return f"[{self.low!r}, {self.high!r}]"

    def __contains__(self, other: Number) -> bool:
        inner = as_interval(other)
        return self.low <= inner.low and inner.high <= self.high

    def __neg__(self) -> Interval:
        return Interval(-self.high, -self.low)

    def __add__(self, other: Number) -> Interval:
        if isinstance(other, Interval):
            low, high = self.low + other.low, self.high + other.high
        else:
            low, high = self.low + other, self.high + other
        return Interval(nextafter(low, -inf), nextafter(high, inf))

    __radd__ = __add__

    def __sub__(self, other: Number) -> Interval:
        return self + -other

    def __rsub__(self, other: float) -> Interval:
        return -self + other

    def __mul__(self, other: Number) -> Interval:
        a, b = self.low, self.high
        if not isinstance(other, Interval):
            if other == 1.0:  # Generated code is full of it.
                return self
            low, high = a * other, b * other
            if other < 0.0:
                low, high = high, low
        else:
            c, d = other.low, other.high
            if a >= 0.0 and c >= 0.0:
                low, high = a * c, b * d
            else:
                ac, ad, bc, bd = a * c, a * d, b * c, b * d
                low, high = min(ac, ad, bc, bd), max(ac, ad, bc, bd)
        return Interval(nextafter(low, -inf), nextafter(high, inf))

    __rmul__ = __mul__

    def __truediv__(self, other: Number) -> Interval:
        return self * _reciprocal(as_interval(other))

    def __rtruediv__(self, other: float) -> Interval:
        return _reciprocal(self) * other

    def __pow__(self, exponent: int) -> Interval:
        if exponent < 0:
            return _reciprocal(self**-exponent)
        if exponent == 2:
            root = absolute(self)
            low, high = root.low * root.low, root.high * root.high
            return Interval(max(nextafter(low, -inf), 0.0), nextafter(high, inf))
        if exponent % 2 == 0:
            return _increasing(lambda x: math.pow(x, exponent), absolute(self), 0.0)
        return _increasing(lambda x: math.pow(x, exponent), self)


def as_interval(number: Number) -> Interval:
    """Returns a number as the interval that holds nothing else."""
    return number if isinstance(number, Interval) else Interval(number, number)


def hull(*numbers: Number) -> Interval:
    """Returns the least interval that holds all of them."""
    intervals = [as_interval(number) for number in numbers]
    return Interval(
        min(each.low for each in intervals), max(each.high for each in intervals)
    )


def _increasing(
    function: Callable[[float], float],
    x: Number,
    least: float = -inf,
    most: float = inf,
) -> Interval:
    """Encloses a function that never falls, with values between least and most."""
    x = as_interval(x)
    low, high = function(x.low), function(x.high)
    return Interval(
        max(low - _LIBRARY_ERROR * math.ulp(low), least),
        min(high + _LIBRARY_ERROR * math.ulp(high), most),
    )


def _reciprocal(x: Interval) -> Interval:
    if x.low <= 0.0 <= x.high:
        raise ZeroDivisionError(f"division by {x}")
    return Interval(nextafter(1.0 / x.high, -inf), nextafter(1.0 / x.low, inf))


def absolute(x: Number) -> Interval:
    """Encloses |x|."""
    x = as_interval(x)
    if x.low >= 0.0:
        return x
    return -x if x.high <= 0.0 else Interval(0.0, max(-x.low, x.high))


def cosine(x: Number) -> Interval:
    """Encloses cos x."""
    return _oscillating(math.cos, 0.0, as_interval(x))


def sine(x: Number) -> Interval:
    """Encloses sin x."""
    return _oscillating(math.sin, 0.5 * math.pi, as_interval(x))


def tangent(x: Number) -> Interval:
    """Encloses tan x.

    Raises:
        ZeroDivisionError: x holds a pole.
    """
    x = as_interval(x)
    if _passes(x, 0.5 * math.pi, math.pi):
        raise ZeroDivisionError(f"tan {x}")
    return _increasing(math.tan, x)


def arc_tangent(y: Number, x: Number) -> Interval:
    """Encloses atan2(y, x).

    Raises:
        ValueError: The jump at y = 0, x <= 0 is among the arguments.
    """
    y, x = as_interval(y), as_interval(x)
    if y.low <= 0.0 <= y.high and x.low <= 0.0:
        raise ValueError(f"atan2({y}, {x}) has no enclosure")
    angles = [math.atan2(b, a) for b in (y.low, y.high) for a in (x.low, x.high)]
    return _increasing(float, hull(*angles))


def power(x: Number, exponent: Number) -> Interval:
    """Encloses a real power; of negative numbers only those with whole exponents."""
    x = as_interval(x)
    if isinstance(exponent, Interval):
        if exponent.low < exponent.high:
            return FUNCTIONS["exp"](exponent * FUNCTIONS["log"](x))
        exponent = exponent.low
    if float(exponent).is_integer():
        return x ** int(exponent)
    if exponent < 0.0:
        return _reciprocal(power(x, -exponent))
    return _increasing(lambda base: math.pow(base, exponent), x, least=0.0)


def _oscillating(
    function: Callable[[float], float], peak: float, x: Interval
) -> Interval:
    """Encloses the sine or the cosine, of which one peak is given."""
    ends = hull(_increasing(function, x.low), _increasing(function, x.high))
    return Interval(
        -1.0 if _passes(x, peak + math.pi, 2.0 * math.pi) else max(ends.low, -1.0),
        1.0 if _passes(x, peak, 2.0 * math.pi) else min(ends.high, 1.0),
    )


def _passes(x: Interval, place: float, period: float) -> bool:
    """Whether x may hold one of the places that come once a period."""
    if max(-x.low, x.high) > _LARGEST_ANGLE:
        return True
    first = math.ceil((x.low - place - _ANGLE_ERROR) / period)
    return first <= math.floor((x.high - place + _ANGLE_ERROR) / period)


def _of_increasing(
    function: Callable[[float], float], least: float = -inf, most: float = inf
) -> Callable[[Number], Interval]:
    return lambda x: _increasing(function, x, least, most)


# By the names they have in generated code.
FUNCTIONS: dict[str, Callable[..., Interval]] = {
    "abs": absolute,
    "max": lambda *numbers: _of_ends(max, numbers),
    "min": lambda *numbers: _of_ends(min, numbers),
    "sqrt": _of_increasing(math.sqrt, least=0.0),
    "exp": _of_increasing(math.exp, least=0.0),
    "log": _of_increasing(math.log),
    "sin": sine,
    "cos": cosine,
    "tan": tangent,
    "asin": _of_increasing(math.asin),
    "acos": lambda x: -_increasing(lambda y: -math.acos(y), x),
    "atan": _of_increasing(math.atan),
    "atan2": arc_tangent,
    "sinh": _of_increasing(math.sinh),
    "cosh": lambda x: _increasing(math.cosh, absolute(x), least=1.0),
    "tanh": _of_increasing(math.tanh, -1.0, 1.0),
    "pow": power,
}


def _of_ends(choose: Callable[..., float], numbers: tuple[Number, ...]) -> Interval:
    intervals = [as_interval(number) for number in numbers]
    return Interval(
        choose(each.low for each in intervals), choose(each.high for each in intervals)
    )


_CASES = (ast.IfExp, ast.Compare, ast.BoolOp)


@lru_cache(maxsize=256)
def interval_function(function: CompiledFunction) -> IntervalFunction:
    """Returns a compiled function's code as a function of intervals and floats.

    It encloses the values of the formula for all arguments inside the intervals, and
    raises where it cannot.

    Args:
        function: A function compiled by `compile_nodes`.

    Raises:
        ModelError: The code tells cases apart, or calls what has no enclosure here.
    """
    if inspect.ismethod(function):
        raise ModelError(
            "no enclosure on intervals, for Drake evaluates this MultibodyPlant: derive"
            " its model by ControlAffineModel.from_system(.., symbolic=True)"
        )
    source = inspect.getsource(function)
    nodes = list(ast.walk(ast.parse(source)))
    called = {
        node.func.id
        for node in nodes
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    obstacles = sorted(called - FUNCTIONS.keys())
    if any(isinstance(node, _CASES) for node in nodes):
        obstacles.append("cases (if-then-else, abs, min, max or their derivatives)")
    if obstacles:
        raise ModelError(
            f"{function.__name__}: no enclosure on intervals, for it has"
            f" {', '.join(obstacles)}"
        )
    name = f"{function.__name__}, on intervals"
    enclosure: IntervalFunction = function_of(source, name, FUNCTIONS)
    return enclosure
