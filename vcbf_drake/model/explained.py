"""Explanations of errors that pydrake's symbols raise, with a remedy."""

from __future__ import annotations

import re

_SYMBOL = "pydrake.symbolic.Expression"


def explained(error: BaseException) -> str:
    """Returns the explanation of an error that a user's function raised on symbols.

    Args:
        error: The error.
    """
    text = first_line(error)
    if "__bool__" in text:
        return (
            "if, max, np.clip, np.where, np.maximum and comparisons need to know what"
            " symbols cannot tell: write a smooth formula, (e + (e**2 + c**2)**0.5) / 2"
            " for max(e, 0) with a small c, or one barrier for each case"
        )
    if _SYMBOL in text and ("real number" in text or "float" in text):
        return (
            "float() and the functions of math take numbers only: write NumPy's"
            " (np.cos), which take symbols too"
        )
    unknown = re.search(r"Expression' object has no attribute '(\w+)'", text)
    unknown = unknown or re.search(r"Expression which has no callable (\w+)", text)
    if unknown and unknown[1] == "hypot":
        return "np.hypot does not know symbols: write (a**2 + b**2)**0.5"
    if unknown:
        return (
            f"'{unknown[1]}' does not know symbols: write it with cos, sin, tan,"
            " arctan2, exp, log, tanh, sqrt and powers"
        )
    missing = re.search(r"entry for the variable (\S+)", text)
    if missing:
        return (
            f"Drake's code looks at the number of {missing[1]}, as that of a BallRpy or"
            " universal joint does (is it near a singular angle?): model the joint by"
            " revolute joints in a row, or a free body by its quaternion"
        )
    if "geometry_query_input_port" in str(error):
        return (
            "the plant is connected to a SceneGraph, and contact has no formula: derive"
            " the model from the same plant parsed on its own, and give that as model"
        )
    return text


def first_line(error: BaseException) -> str:
    """Returns the first informative line of an error's text."""
    lines = (line.strip(" :") for line in str(error).splitlines())
    return next(filter(None, lines), type(error).__name__)
