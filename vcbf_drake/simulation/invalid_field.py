"""A field of a scenario that is not what it must be: where it is, and why."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
import re
from typing import Any, TypeAlias

from vcbf_drake.errors import ScenarioError, VcbfError

# Keys and list indices from the top of a scenario down to one value.
KeyPath: TypeAlias = tuple[str | int, ...]


def key_path(path: KeyPath) -> str:
    """Returns the path as it is written, for example ``obstacles[1].radius``."""
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in path)
    return "".join(parts).removeprefix(".")


class InvalidFieldError(ScenarioError):
    """A field of a scenario has a value that is not allowed.

    Attributes:
        path: Where the field is.
    """

    def __init__(self, path: KeyPath, problem: str) -> None:
        super().__init__(f"{key_path(path)}: {problem}")
        self.path = path


def require(allowed: bool, path: KeyPath, value: object, rule: str) -> None:
    """Refuses a value that is not allowed.

    Args:
        allowed: Whether it is.
        path: Where it is.
        value: What was found.
        rule: What it must be.

    Raises:
        InvalidFieldError: It is not allowed.
    """
    if not allowed:
        shown = f"{value:g}" if isinstance(value, float) else repr(value)
        shown = shown if len(shown) <= 200 else f"{shown[:197]}..."
        raise InvalidFieldError(path, f"{shown}; it must be {rule}")


def ask(check: Callable[[], Any], owner: object, path: KeyPath) -> Any:
    """Returns what a check of a field's owner returns; its errors name the field.

    Raises:
        InvalidFieldError: The check raised a `ValueError` or a `VcbfError`.
    """
    try:
        return check()
    except (ValueError, VcbfError) as error:
        # Such messages begin with the field: "Sinusoid.phase is nan; it must be ..."
        match = re.match(r"([\w.\[\]]+)(?::| is)? (.*)", str(error), re.DOTALL)
        keys = re.findall(r"\w+", match[1]) if match else []
        names = {each.name for each in fields(owner)}  # type: ignore[arg-type]
        keys = keys if keys[:1] and keys[0] in names else keys[1:]
        if match and keys and keys[0] in names:
            below = (int(key) if key.isdigit() else key for key in keys)
            raise InvalidFieldError((*path, *below), match[2]) from None
        raise InvalidFieldError(path, str(error)) from None
