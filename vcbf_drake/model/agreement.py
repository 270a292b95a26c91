"""Numerical comparison of a derived function with its origin.

Symbolic expressions are simplified as they are built, and not always rightly: pydrake
turns ``((x - a)**2)**0.5`` into ``x - a``, a wall's distance into one that is negative
behind it. So every derived function is compared with its origin in plain numbers: at
points near and far, of both signs, and at and around given places.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
import math
from typing import Any, TypeAlias
import warnings

import numpy as np
from numpy.typing import NDArray
from pydrake.symbolic import Expression

from vcbf_drake.checks import Array
from vcbf_drake.errors import ModelError

NumberFunction: TypeAlias = Callable[[Array], Iterable[Any]]

# Far enough for coordinates of a map; a few for what was compared at many before.
MANY_SCALES = tuple(np.geomspace(1e-2, 1e7, 36).tolist())
FEW_SCALES = (0.3, 3.0)
# The largest relative difference of two ways to calculate one number.
_TOLERANCE = 1e-6
# A relative change of the arguments that shows the effect of rounding.
_NEXT_TO_NOTHING = 1e-13
_ROUNDING_FACTOR = 100.0
# Fewer points than this are too few to say that two functions agree.
_FEW = 4
_WAY_OUT = (
    "pydrake simplifies the power of a power, (e**2)**0.5 to e: write"
    " (e**2 + c**2)**0.5 with a small c, or one formula for each sign of e"
)


def sample_points(
    size: int,
    places: Sequence[float] | Array = (),
    scales: Sequence[float] = MANY_SCALES,
) -> Iterator[Array]:
    """Yields arguments to compare at, shape (size,); the same ones every time.

    They come in opposite pairs, at the distances `scales`: around 0 first, then around
    vectors of the places and their negatives, each after the place itself.
    """
    random = np.random.default_rng(0)
    around = np.concatenate([[0.0], places, np.negative(places)])
    for i, scale in enumerate(scales):
        center = random.choice(around, size) if i % 2 else np.zeros(size)
        offset = scale * random.normal(size=size)
        yield center + offset
        yield center - offset
        if i % 4 == 1:
            yield center


def require_agreement(
    derived: NumberFunction,
    origin: NumberFunction,
    points: Iterable[Array],
    describe: Callable[[Array], str],
    names: Sequence[str],
) -> None:
    """Compares a derived function with its origin.

    Points where the origin has no finite value are passed over, as are those where the
    derived function divides by 0, takes the logarithm of 0 or overflows: it may, in
    another order of operations. If hardly a point is left, a warning says so.

    Args:
        derived: Returns k numbers, or raises.
        origin: Returns the k numbers that are right, or raises.
        points: The points of comparison.
        describe: Returns a point in words.
        names: The names of the k numbers; one name for all of them.

    Raises:
        ModelError: They differ, or the origin's values differ from call to call.
    """
    compared, points = 0, list(points)
    for point in points:
        values = _values(derived, origin, point)
        if values is None:
            continue
        expected, found, differs = values
        if not compared:
            _require_repeatable(origin, point, expected, describe, names)
        if differs.any():
            rounding = _rounding(derived, point, found)
            rounding = np.fmax(rounding, _rounding(origin, point, expected))
            differs &= ~(np.abs(found - expected) <= rounding)
        if differs.any():
            is_singular = np.isnan(found[differs]).all()
            if is_singular and _agree_nearby(derived, origin, point):
                continue
            k = int(differs.argmax())
            name, right, wrong = names[k % len(names)], expected[k], found[k]
            raise ModelError(
                f"{name} is {right:.6g} at {describe(point)}, but what pydrake makes"
                f" of its symbols is {wrong:.6g} there: {_WAY_OUT}"
            )
        compared += 1
    if compared < min(_FEW, len(points)):
        warnings.warn(
            f"{names[0]} is finite at {compared} of {len(points)} points only, too few"
            " to tell whether what was derived from it has the same values",
            stacklevel=2,
        )


def _require_repeatable(
    origin: NumberFunction,
    point: Array,
    first: Array,
    describe: Callable[[Array], str],
    names: Sequence[str],
) -> None:
    """Refuses a function whose values differ from call to call."""
    second = _numbers(origin, point)
    if second is None or not (second == first).all():
        k = 0 if second is None else int((second != first).argmax())
        then = "nothing" if second is None else f"{second[k]:.6g}"
        raise ModelError(
            f"{names[k % len(names)]} is {first[k]:.6g} and then {then} at one point,"
            f" {describe(point)}; it must depend on its arguments alone"
        )


def _numbers(function: NumberFunction, point: Array) -> Array | None:
    """The function's values, nan where they are not real; None if it raises."""
    try:
        with np.errstate(all="ignore"):
            values = np.asarray(function(point), dtype=object).flat
            # Expressions without a variable are numbers too.
            plain = (v.Evaluate() if isinstance(v, Expression) else v for v in values)
            return np.array([*map(float, plain)])
    except ArithmeticError:
        return None
    except ValueError:  # The root of a negative number, say.
        return np.array([math.nan])
    except (TypeError, RuntimeError):
        return None


def _values(
    derived: NumberFunction, origin: NumberFunction, point: Array
) -> tuple[Array, Array, NDArray[np.bool_]] | None:
    """The right values, those found and where they differ; None without values."""
    expected, found = _numbers(origin, point), _numbers(derived, point)
    if expected is None or found is None or not np.isfinite(expected).all():
        return None
    found = np.broadcast_to(found, expected.shape)
    tolerance = _TOLERANCE * np.fmax(np.abs(found), np.abs(expected))
    return expected, found, ~(np.abs(found - expected) <= tolerance)


def _agree_nearby(
    derived: NumberFunction, origin: NumberFunction, point: Array
) -> bool:
    """Whether a point without a value is isolated: both functions agree around it."""
    random = np.random.default_rng(0)
    for _ in range(8):
        beside = point + 1e-3 * random.normal(size=point.shape)
        values = _values(derived, origin, beside)
        if values is None or values[2].any():
            return False
    return True


def _rounding(function: NumberFunction, point: Array, values: Array) -> Array:
    """The bound of the rounding error of a function's values, shape (k,)."""
    random = np.random.default_rng(0)
    changes = [np.zeros_like(values)]
    for _ in range(4):
        nudge = 1.0 + _NEXT_TO_NOTHING * random.normal(size=point.shape)
        nearby = _numbers(function, point * nudge)
        if nearby is not None:
            changes.append(np.abs(nearby - values))
    rounding: Array = _ROUNDING_FACTOR * np.fmax.reduce(changes)
    return rounding
