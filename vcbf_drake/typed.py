"""Arguments and fields beside the types that they are declared with.

A number in quotes, None, or a list of lists where a list belongs is answered where it
is given, in one line, and not by an unrelated error later. A type in `Annotated` has
further checks of its values: their ranges.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, is_dataclass
from functools import cache, partial, wraps
import inspect
from numbers import Integral, Real
import re
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
# Those of the Python file used last come before others of their tags.
classes_in_use: list[Any] = []

_P = ParamSpec("_P")
_R = TypeVar("_R")

_NUMBERS: dict[Any, Any] = {float: Real, int: Integral, bool: (bool, np.bool_)}
_WORDS: dict[Any, str] = {
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    str: "text",
    types.NoneType: "None",
    np.ndarray: "numbers",
    Callable: "a function",
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
        made: The new instance.
        prefix: The start of the path: "box: " for example.

    Raises:
        InvalidValueError: A field is of another type.
    """
    kind: Any = type(made)
    for name, hint in field_types(kind).items():
        check_type(prefix + name, getattr(made, name), hint)


def tag_of(kind: Any) -> str:
    """Returns a class's tag in a scenario: ``!Car`` of CarVehicle, for example."""
    name = re.sub("(Vehicle|Obstacle)$", "", kind.__name__)
    return str(getattr(kind, "TAG", f"!{name}"))


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
    is_list = _is_list(value)
    is_nested = is_list and len(value) > 0 and _is_list(value[0])
    item = item_of(members, is_nested)
    require(is_list and item is not None, path, value, in_words(hint))
    for each in members:
        sizes = get_args(each)
        if get_origin(each) is tuple and Ellipsis not in sizes:
            require(len(value) == len(sizes), path, value, f"{len(sizes)} values")
    for index, each in enumerate(value):
        check_type((*path, index), each, item)


@cache
def field_types(kind: Any) -> dict[str, Any]:
    """Returns the types of a dataclass's fields as they are declared, with ranges."""
    hints = get_type_hints(kind, include_extras=True)
    for base in reversed(kind.__mro__):
        hints |= _declared.get(base, {})
    return {each.name: hints[each.name] for each in fields(kind)}


def members_of(hint: Any) -> list[Any]:
    """Returns the types a hint allows; an array beside lists is one of them."""
    if hint == ArrayLike:
        return [Array]
    is_union = get_origin(hint) in (types.UnionType, Union)
    members = [*get_args(hint)] if is_union else [hint]
    lists = [*filter(None, map(item_type, members))]
    return [each for each in members if not (lists and get_origin(each) is np.ndarray)]


def allowed_types(hint: Any) -> list[Any]:
    """Returns the bare types that a hint allows: of an abstract class, its subclasses.

    None is the last of them.
    """
    if inspect.isabstract(hint):
        known = hint.__subclasses__()
        for each in known:
            known += each.__subclasses__()
        return [each for each in known if not inspect.isabstract(each)]
    return sorted(map(bare, members_of(hint)), key=lambda each: each is types.NoneType)


def tagged_types(hint: Any) -> dict[str, Any]:
    """Returns the dataclasses that a hint allows, by their tags.

    For one tag it is the package's own class, or that of the Python file used last, or
    the one defined last.
    """
    found = [each for each in allowed_types(hint) if is_dataclass(each)]
    used = [each for each in found if each in classes_in_use]
    own = [each for each in found if each.__module__.startswith("vcbf_drake.")]
    return {tag_of(each): each for each in (*found, *used, *own)}


def item_of(members: Iterable[Any], is_nested: bool) -> Any:
    """Returns the type of a list's items: lists, where they are nested and may be."""
    items = [each for each in map(item_type, members) if each is not None]
    lists = [each for each in items if item_type(members_of(each)[0]) is not None]
    return next(iter(lists if is_nested and lists else items), None)


def item_type(hint: Any) -> Any:
    """Returns the type of the items of a list or a tuple; None of anything else."""
    if get_origin(hint) in (list, Sequence, Iterable, tuple):
        return get_args(hint)[0]
    return None


def _is_list(value: Any) -> bool:
    is_array = isinstance(value, np.ndarray) and value.ndim > 0
    return is_array or (isinstance(value, Sequence) and not isinstance(value, str))


def _is(value: Any, hint: Any) -> bool:
    """Whether a value is of one type, its items and its range left to be looked at."""
    hint = bare(hint)
    origin = get_origin(hint) or hint
    if origin is Literal:
        return isinstance(value, str) and value in get_args(hint)
    if hint is Any:
        return True
    if hint in _NUMBERS:
        is_boolean = isinstance(value, _NUMBERS[bool])
        return isinstance(value, _NUMBERS[hint]) and is_boolean == (hint is bool)
    if origin is np.ndarray:
        return _is_array(value, hint)
    if item_type(hint) is not None:
        return False  # Its items are looked at one by one.
    is_protocol = getattr(origin, "_is_protocol", False)
    if is_protocol and not getattr(origin, "_is_runtime_protocol", False):
        return True
    return not isinstance(origin, type) or isinstance(value, origin)


def bare(hint: Any) -> Any:
    """Returns a type without what is annotated."""
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint


def _is_array(value: Any, hint: Any) -> bool:
    of_numbers = np.float64 in get_args(get_args(hint)[-1])
    try:
        array = np.asarray(value)
        if of_numbers and array.dtype.kind == "O":
            array = array.astype(float)
    except (TypeError, ValueError):  # Lists of different lengths, for example.
        return False
    return array.dtype.kind in "fiuO"


def in_words(hint: Any) -> str:
    """Returns the types that a hint allows, in words for messages."""
    return " or ".join(dict.fromkeys(map(_in_words, members_of(hint))))


def _in_words(hint: Any) -> str:
    hint = bare(hint)
    kind = get_origin(hint) or hint
    if (item := item_type(hint)) is not None:
        inner, *others = map(bare, members_of(item))
        if others:
            return "a list"
        name = _PLURALS.get(inner) or f"{getattr(inner, '__name__', 'value')}s"
        is_nested = item_type(inner) is not None
        return f"a list of {'lists of numbers' if is_nested else name}"
    if kind is Literal:
        return f"one of {', '.join(get_args(hint))}"
    name = getattr(kind, "__name__", str(kind)).removesuffix("_[float]")
    return _WORDS.get(kind) or f"a{'n' * (name[0] in 'AEIOU')} {name}"
