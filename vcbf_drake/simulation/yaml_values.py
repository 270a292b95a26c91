"""Dataclasses from YAML's nodes by their type hints, and back to plain data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
import inspect
import math
from pathlib import Path
import re
from types import NoneType
from typing import Any, get_args, get_origin

import numpy as np
import yaml

from vcbf_drake.checks import require
from vcbf_drake.errors import InvalidValueError, Path as KeyPath, below
from vcbf_drake.files import names_file, resolved
from vcbf_drake.simulation.yaml_nodes import (
    Node,
    did_you_mean,
    directory_of,
    entries_of,
    shown,
)
from vcbf_drake.typed import (
    bare,
    check_type,
    field_types,
    in_words,
    item_type,
    members_of,
    tag_of,
)

# The notations of an angle: 90deg, 90°, pi/2.
_ANGLE = re.compile(r"\d *(deg|°)|\bpi\b|\brad\b")
# No quantity is as large, in SI units; a product of a few such numbers is still finite.
_LARGEST = 1e15


def allowed_types(hint: Any) -> list[Any]:
    """Returns the types that a hint allows: of an abstract class, its subclasses.

    None is the last of them.
    """
    if inspect.isabstract(hint):
        return [*_concrete(hint)]
    return sorted(map(bare, members_of(hint)), key=lambda each: each is NoneType)


def _concrete(kind: Any) -> Iterator[Any]:
    """The subclasses of a class, and theirs, but for those that are abstract."""
    for each in kind.__subclasses__():
        if not inspect.isabstract(each):
            yield each
        yield from _concrete(each)


def tagged_types(hint: Any) -> dict[str, Any]:
    """Returns the dataclasses that a hint allows, by their tags.

    For one tag it is the package's own class, or the one defined last.
    """
    found = [each for each in allowed_types(hint) if is_dataclass(each)]
    own = [each for each in found if each.__module__.startswith("vcbf_drake.")]
    return {tag_of(each): each for each in (*found, *own)}


def build(node: Node, hint: Any, path: KeyPath = ()) -> Any:
    """Returns the value of a node, of a given type.

    Raises:
        InvalidValueError: It holds something else.
    """
    classes, (kind, *others) = tagged_types(hint), allowed_types(hint)
    if NoneType in others and shown(node) == "nothing":
        return None
    is_mapping = isinstance(node, yaml.MappingNode)
    if is_dataclass(kind) or (classes and is_mapping):
        return _build_object(node, classes, path, inspect.isabstract(hint))
    if node.tag.startswith("!"):
        raise InvalidValueError(path, f"tag {node.tag}; no tag is expected here")
    item = item_type(kind)
    if item is None and isinstance(node, yaml.ScalarNode):
        return _build_scalar(node, kind, path)
    if item is None or not isinstance(node, yaml.SequenceNode):
        expected = in_words(hint) if item is None else "a list"
        raise InvalidValueError(path, f"expected {expected}, got {shown(node)}")
    made = [build(each, item, (*path, i)) for i, each in enumerate(node.value)]
    if get_origin(kind) is not tuple:
        return made
    size = len(get_args(kind))
    is_whole = Ellipsis in get_args(kind) or len(made) == size
    require(is_whole, path, made, f"{size} values")
    return tuple(made)


def _build_object(
    node: Node, classes: Mapping[str, Any], path: KeyPath, needs_tag: bool
) -> Any:
    tag, (first, *others), guess = node.tag, classes, ""
    if not tag.startswith("!"):
        if needs_tag:
            missing = f"its tag is missing; allowed: {', '.join(classes)}"
            raise InvalidValueError(path, missing)
        tag = first
        guess = f" (no tag, so read as {first}; or {', '.join(others)})" * bool(others)
    if tag not in classes:
        unknown = f"unknown tag {tag}; {did_you_mean(tag, classes)}"
        raise InvalidValueError(path, unknown)
    if not isinstance(node, yaml.MappingNode):
        raise InvalidValueError(path, f"expected a mapping, got {shown(node)}")
    schema, values = classes[tag], {}
    hints = field_types(schema)
    for name, (_, value) in entries_of(node).items():
        place = (*path, name)
        if name not in hints:
            advice = did_you_mean(name, hints)
            if name in getattr(schema, "MOVED", {}):
                advice = f"it is {schema.MOVED[name]} now"
            raise InvalidValueError(place, f"unknown key{guess}; {advice}")
        values[name] = build(value, hints[name], place)
        check_type(place, values[name], hints[name])
    for each in fields(schema):
        if each.name in values and names_file(each):
            written_in = directory_of(entries_of(node)[each.name][1])
            values[each.name] = resolved(values[each.name], written_in)
        needed = each.default is each.default_factory is MISSING
        if needed and each.name not in values:
            raise InvalidValueError((*path, each.name), f"missing{guess}")
    with below(*path):
        return schema(**values)


def _build_scalar(node: Node, kind: Any, path: KeyPath) -> float | bool | str | None:
    """Returns a number, a word or nothing; what is quoted, or no other, is text."""
    text, is_quoted = node.value, node.style is not None
    if is_quoted or (kind is str and node.tag.endswith(":str")):
        return text
    if shown(node) == "nothing":
        return None
    if text.lower() in yaml.SafeLoader.bool_values:
        return yaml.SafeLoader.bool_values[text.lower()]
    try:
        # YAML 1.1 takes 1e-3 for text; .inf and .nan are its own.
        digits = text.lower().replace(".inf", "inf").replace(".nan", "nan")
        number = float(digits) if kind is float else int(digits)
    except ValueError:
        is_angle = kind is float and _ANGLE.search(text.lower()) is not None
        require(not is_angle, path, text, "a number, in radians: 1.5708 for 90 degrees")
        return text
    if _LARGEST < abs(number) < math.inf:
        rule = f"it must be at most {_LARGEST:g} in size"
        raise InvalidValueError(path, f"{text[:99]}; {rule}")
    return number


def plain(value: Any, hint: Any) -> Any:
    """Returns plain data for YAML; a member of a union has its tag."""
    if is_dataclass(value):
        kind: Any = type(value)
        hints = field_types(kind)
        data = {key: plain(getattr(value, key), hints[key]) for key in hints}
        for each in filter(names_file, fields(value)):
            data[each.name] = resolved(data[each.name], Path())
        is_one_of = len(tagged_types(hint)) > 1 or inspect.isabstract(hint)
        return {"_tag": tag_of(kind), **data} if is_one_of else data
    if isinstance(value, list | tuple | np.ndarray):
        item = item_type(allowed_types(hint)[0])
        return [plain(each, item) for each in value]
    return value.item() if isinstance(value, np.generic) else value
