"""The array type, and checks of the numbers and words that a user gives."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
import difflib
import math
from numbers import Real
import reprlib
from textwrap import shorten
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcbf_drake.errors import InvalidValueError, Path

Array = NDArray[np.float64]

# Lists are cut in messages, paths of files are not.
_SHORT = reprlib.Repr()
_SHORT.maxstring = 300


def check_parameter(
    name: str | Path,
    value: Any,
    *,
    size: int | None = None,
    zero_allowed: bool = False,
    infinity_allowed: bool = False,
) -> None:
    """Checks that a parameter is made of finite, positive numbers.

    Args:
        name: The parameter's name, or the path to it, for the message.
        value: The number, or the list of numbers if `size` is given.
        size: The required length of the list; None for a single number.
        zero_allowed: Whether 0 is allowed too.
        infinity_allowed: Whether infinity is allowed too.

    Raises:
        InvalidValueError: It is not.
    """
    bound = "not below 0" if zero_allowed else "above 0"
    _check_numbers(
        name,
        value,
        size,
        lambda v: (
            (v > 0.0 or (zero_allowed and v == 0.0))
            and (infinity_allowed or math.isfinite(v))
        ),
        bound if infinity_allowed else f"finite and {bound}",
    )


def check_finite(
    name: str | Path,
    value: Any,
    *,
    size: int | None = None,
    names: Sequence[str] | None = None,
    infinity_allowed: bool = False,
) -> None:
    """Checks that a parameter is made of finite numbers.

    Args:
        name: The parameter's name, or the path to it, for the message.
        value: The number, or the list of numbers if `size` or `names` is given.
        size: The required length of the list; None for a single number.
        names: Or what each of them is called.
        infinity_allowed: Whether infinity, of either sign, is allowed too.

    Raises:
        InvalidValueError: It is not.
    """
    if names is not None:
        size = len(names)
        rule = f"{size} numbers, one each of {', '.join(names)}"
        require(len(value) == size, name, value, rule)
    if infinity_allowed:
        _check_numbers(name, value, size, lambda v: not math.isnan(v), "a number")
    else:
        _check_numbers(name, value, size, math.isfinite, "finite")


def check_share(name: str | Path, value: Any) -> None:
    """Checks that a parameter is a number from 0 to 1.

    Args:
        name: The parameter's name, or the path to it, for the message.
        value: The number.

    Raises:
        InvalidValueError: It is not.
    """
    check_parameter(name, value, zero_allowed=True)
    require(value <= 1.0, name, value, "from 0 to 1")


def require(allowed: bool, name: str | Path, value: object, rule: str) -> None:
    """Refuses a value that is not allowed.

    Args:
        allowed: Whether it is.
        name: Its name, or the path to it.
        value: The given value.
        rule: The requirement.

    Raises:
        InvalidValueError: It is not allowed.
    """
    if not allowed:
        if isinstance(value, np.ndarray):
            value = value.tolist()
        shown = f"{value:g}" if isinstance(value, float) else _SHORT.repr(value)
        raise InvalidValueError(name, f"{shown}; it must be {rule}")


def require_choice(name: str | Path, value: object, allowed: Collection[str]) -> None:
    """Refuses a word that is not among those allowed.

    Args:
        name: Its name, or the path to it.
        value: The given value.
        allowed: The words.

    Raises:
        InvalidValueError: It is not allowed.
    """
    known = isinstance(value, str) and value in allowed
    require(known, name, value, f"one of {', '.join(allowed)}")


def did_you_mean(word: str, allowed: Iterable[str]) -> str:
    """Returns the close matches of a word, or what is allowed, on one line."""
    allowed = list(allowed)
    if matches := difflib.get_close_matches(word, allowed, n=2):
        return f"did you mean {' or '.join(matches)}?"
    known = shorten(", ".join(allowed) or "none", 300, placeholder=" and more")
    return f"allowed: {known}"


def _check_numbers(
    name: str | Path,
    value: Any,
    size: int | None,
    is_allowed: Callable[[float], bool],
    rule: str,
) -> None:
    path = (name,) if isinstance(name, str) else name
    if size is None:
        require(isinstance(value, Real) and is_allowed(float(value)), path, value, rule)
        return
    is_list = isinstance(value, Sequence | np.ndarray) and len(value) == size
    require(is_list, path, value, f"a list of {size} number{'s' * (size != 1)}")
    for index, each in enumerate(value):
        _check_numbers((*path, index), each, None, is_allowed, rule)


def finite_array(values: Any, name: str | Path, dimensions: int, rule: str) -> Array:
    """Returns a copy of the values as floats.

    Args:
        values: The numbers.
        name: The name of the values, or their path, for the error message.
        dimensions: The required number of dimensions.
        rule: The requirement, for the error message.

    Raises:
        InvalidValueError: Not numbers, in rows of other lengths, or not finite.
    """
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError):
        array = np.full((1,) * dimensions, math.nan)
    fits = array.ndim == dimensions and bool(np.isfinite(array).all())
    require(fits, name, values, rule)
    return array


def finite_vector(values: Sequence[float] | Array, name: str) -> Array:
    """Returns a read-only copy of the values as floats, shape (k,).

    Args:
        values: The numbers.
        name: The name of the values, for the error message.

    Raises:
        InvalidValueError: Not one-dimensional, or not finite.
    """
    vector = finite_array(values, name, 1, "a flat list of finite numbers")
    vector.flags.writeable = False
    return vector
