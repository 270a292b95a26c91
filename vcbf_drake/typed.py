"""Arguments and fields beside the types that they are declared with.

A number in quotes, None, or a list of lists where a list belongs is answered where it
is given, in one line, and not by whatever trips over it later. A type in `Annotated`
has further checks of its values: their ranges.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial, wraps
import inspect
from numbers import Integral, Real
import types
from typing import (
    Annotated,
    Any,
    Literal,
    ParamSpec,
    TypeAlias,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from numpy.typing import ArrayLike

from vcbf_drake.checks import (
    Array,
    check_finite,
    check_parameter,
    check_share,
    require,
)
from vcbf_drake.errors import Path

_not_negative = partial(check_parameter, zero_allowed=True)
Finite: TypeAlias = Annotated[float, check_finite]
Positive: TypeAlias = Annotated[float, check_parameter]
PositiveInt: TypeAlias = Annotated[int, check_parameter]
NotNegative: TypeAlias = Annotated[float, _not_negative]
NotNegativeInt: TypeAlias = Annotated[int, _not_negative]
PositiveOrInfinite: TypeAlias = Annotated[
    float, partial(check_parameter, infinity_allowed=True)
]
Share: TypeAlias = Annotated[float, check_share]

# The types of fields as they were declared, by their class.
_declared: dict[type, dict[str, Any]] = {}

_P = ParamSpec("_P")
_R = TypeVar("_R")

_BOOLEANS = (bool, np.bool_)
TYPE_WORDS = {
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    str: "text",
}
_PLURALS = {float: "numbers", int: "whole numbers", str: "texts"}


def typed(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Makes a function refuse arguments that are not of its parameters' types.

    Raises:
        InvalidValueError: When it is called with one; the path is the parameter.
    """
    signature = inspect.signature(function)
    hints: dict[str, Any] = {}

    @wraps(function)
    def checked(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if not hints:
            hints.update(get_type_hints(function, include_extras=True))
        try:
            arguments = signature.bind(*args, **kwargs).arguments
        except TypeError as error:
            raise TypeError(f"{function.__name__}() {error}") from None
        for name, value in arguments.items():
            if name in hints:
                check_type(name, value, hints[name])
        return function(*args, **kwargs)

    return checked


def check_fields(made: Any, prefix: str = "") -> None:
    """Checks the fields of a dataclass against their types.

    Args:
        made: What was made.
        prefix: What the path begins with: "box: " for example.

    Raises:
        InvalidValueError: A field is of another type.
    """
    kind: Any = type(made)
    for name, hint in _field_hints(kind).items():
        check_type(prefix + name, getattr(made, name), hint)


class Checked:
    """A dataclass that checks its fields when it is made; the base of such.

    The fields themselves get plain types, for these are what `pydrake.common.yaml` can
    read and write: it knows no `Annotated`.
    """

    def __init_subclass__(cls) -> None:
        """Puts the declared types aside, with their ranges, for `check_fields`."""
        super().__init_subclass__()
        declared = vars(cls).get("__annotations__", {})
        if any(isinstance(hint, str) for hint in declared.values()):
            return  # Written as texts, which Drake cannot read in any case.
        _declared[cls] = declared
        plain = get_type_hints(cls)
        cls.__annotations__ = {name: plain[name] for name in declared}

    def __post_init__(self) -> None:
        check_fields(self)


def check_type(path: str | Path, value: Any, hint: Any) -> None:
    """Checks one value against a type hint; callables, and what has no check, pass.

    Raises:
        InvalidValueError: It is of another type, or outside the type's range.
    """
    path = (path,) if isinstance(path, str) else path
    members = members_of(hint)
    for each in members:
        if _is(value, each):
            for check in getattr(each, "__metadata__", ()):
                check(path, value)
            return
    items = [_item(each) for each in members if _item(each) is not None]
    if items and _is_list(value):
        nested = len(value) > 0 and _is_list(value[0])
        deeper = [each for each in items if _item(members_of(each)[0]) is not None]
        for index, item in enumerate(value):
            check_type(
                (*path, index), item, deeper[0] if nested and deeper else items[0]
            )
        return
    rule = " or ".join(dict.fromkeys(map(_in_words, members)))
    require(False, path, value, rule)


@cache
def _field_hints(kind: Any) -> dict[str, Any]:
    hints = get_type_hints(kind, include_extras=True)
    for base in reversed(kind.__mro__):
        hints |= _declared.get(base, {})
    return {name: hints[name] for name in kind.__dataclass_fields__}


def members_of(hint: Any) -> list[Any]:
    """Returns the types a hint allows; an array beside lists is one of them."""
    if hint == ArrayLike:
        return [Array]
    is_union = get_origin(hint) in (types.UnionType, Union)
    members = [*get_args(hint)] if is_union else [hint]
    lists = [each for each in members if _item(each) is not None]
    return [each for each in members if not (lists and get_origin(each) is np.ndarray)]


def _item(hint: Any) -> Any:
    """The type of a list's items; None for what is no list of one type."""
    if get_origin(hint) in (list, Sequence, Iterable):
        return get_args(hint)[0]
    return None


def _is_list(value: Any) -> bool:
    is_array = isinstance(value, np.ndarray) and value.ndim > 0
    return is_array or (isinstance(value, Sequence) and not isinstance(value, str))


def _is(value: Any, hint: Any) -> bool:
    """Whether a value is of one type, its items and its range left to be looked at."""
    hint = _bare(hint)
    origin = get_origin(hint) or hint
    if hint is Any:
        return True
    if hint is None or hint is types.NoneType:
        return value is None
    if origin is Literal:
        return isinstance(value, str) and value in get_args(hint)
    if hint is float:
        return isinstance(value, Real) and not isinstance(value, _BOOLEANS)
    if hint is int:
        return isinstance(value, Integral) and not isinstance(value, _BOOLEANS)
    if hint is bool:
        return isinstance(value, _BOOLEANS)
    if origin is np.ndarray:
        return _is_array(value, hint)
    if origin is Callable:
        return callable(value)
    if origin in (dict, Mapping):
        return isinstance(value, Mapping)
    if _item(hint) is not None:
        return False  # Its items are looked at one by one.
    if isinstance(origin, type) and not _is_unchecked(origin):
        return isinstance(value, origin)
    return True


def _bare(hint: Any) -> Any:
    """A type without what is annotated."""
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint


def _is_unchecked(kind: Any) -> bool:
    is_protocol = getattr(kind, "_is_protocol", False)
    return bool(is_protocol and not getattr(kind, "_is_runtime_protocol", False))


def _is_array(value: Any, hint: Any) -> bool:
    of_numbers = np.float64 in get_args(get_args(hint)[-1])
    try:
        array = np.asarray(value)
        if of_numbers and array.dtype.kind == "O":
            array = array.astype(float)
    except (TypeError, ValueError):  # Lists of different lengths, for example.
        return False
    return array.dtype.kind in "fiuO"


def _in_words(hint: Any) -> str:
    hint = _bare(hint)
    item = _item(hint)
    if item is not None:
        inner = _bare(members_of(item)[0])
        lists = _item(inner) is not None
        name = "lists" if lists else _PLURALS.get(inner, "")
        name = name or getattr(inner, "__name__", "values") + "s"
        return f"a list of {name}" + (" of numbers" if lists else "")
    if hint is None or hint is types.NoneType:
        return "None"
    if get_origin(hint) is Literal:
        return f"one of {', '.join(get_args(hint))}"
    if get_origin(hint) is np.ndarray:
        return "numbers"
    if get_origin(hint) is Callable:
        return "a function"
    kind = get_origin(hint) or hint
    name = getattr(kind, "__name__", str(kind)).removesuffix("_[float]")
    return TYPE_WORDS.get(kind) or f"a{'n' * (name[0] in 'AEIOU')} {name}"
