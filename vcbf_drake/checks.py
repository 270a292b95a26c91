"""The array type, and checks of the numbers that a user gives."""

from __future__ import annotations

from collections.abc import Collection
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def check_parameter(
    name: str,
    value: Any,
    *,
    size: int | None = None,
    zero_allowed: bool = False,
    infinity_allowed: bool = False,
) -> None:
    """Checks that a parameter is made of finite, positive numbers.

    Args:
        name: What the parameter is called, for the message.
        value: The number, or the list of numbers if `size` is given.
        size: How many numbers the list must have; None for a single number.
        zero_allowed: Whether 0 is allowed too.
        infinity_allowed: Whether infinity is allowed too.

    Raises:
        ValueError: It is not.
    """
    numbers = [value] if size is None else value
    bound = "not below 0" if zero_allowed else "above 0"
    allowed = bound if infinity_allowed else f"finite and {bound}"
    try:
        valid = len(numbers) == (size or 1) and all(
            (v > 0.0 or (zero_allowed and v == 0.0))
            and (infinity_allowed or math.isfinite(v))
            for v in numbers
        )
    except TypeError:
        valid = False
    if not valid:
        what = "one number" if size is None else f"a list of {size} numbers, each"
        raise ValueError(f"{name} is {value!r}; it must be {what} {allowed}")


def require(allowed: bool, name: str, value: object, rule: str) -> None:
    """Refuses a value that is not allowed.

    Args:
        allowed: Whether it is.
        name: What it is called.
        value: What was given.
        rule: What it must be.

    Raises:
        ValueError: It is not allowed.
    """
    if not allowed:
        shown = f"{value:g}" if isinstance(value, float) else repr(value)
        raise ValueError(f"{name}: {shown}; it must be {rule}")


def require_choice(name: str, value: object, allowed: Collection[str]) -> None:
    """Refuses a word that is not among those allowed.

    Args:
        name: What it is called.
        value: What was given.
        allowed: The words.

    Raises:
        ValueError: It is not allowed.
    """
    require(value in allowed, name, value, f"one of {', '.join(allowed)}")
