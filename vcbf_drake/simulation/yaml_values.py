"""Dataclasses from YAML's nodes by their type hints, and back to plain data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
import inspect
import math
from pathlib import Path
import re
import types
from typing import Any, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
import yaml

from vcbf_drake.errors import Path as KeyPath, below
from vcbf_drake.files import names_file, resolved
from vcbf_drake.simulation.yaml_nodes import (
    Node,
    did_you_mean,
    directory_of,
    entries_of,
    fail,
    shown,
)
from vcbf_drake.typed import TYPE_WORDS

# What people write for an angle: 90deg, 90°, pi/2.
_ANGLE = re.compile(r"\d *(deg|°)|\bpi\b|\brad\b")
# No quantity is as large, in SI units; a product of a few such numbers is still finite.
_LARGEST = 1e15


def allowed_types(hint: Any) -> tuple[Any, ...]:
    """Returns the types that a hint allows: of an abstract class, its subclasses.

    None is the last of them.
    """
    if inspect.isabstract(hint):
        return tuple(_concrete(hint))
    is_union = get_origin(hint) in (types.UnionType, Union)
    members = get_args(hint) if is_union else (hint,)
    lists = [each for each in members if get_origin(each) is not np.ndarray]
    return tuple(sorted(lists, key=lambda each: each is types.NoneType))


def _concrete(kind: Any) -> Iterator[Any]:
    """The subclasses of a class, and theirs, but for those that are abstract."""
    for each in kind.__subclasses__():
        if not inspect.isabstract(each):
            yield each
        yield from _concrete(each)


def item_type(hint: Any) -> Any:
    """Returns the type of the items of a list or a tuple; None of anything else."""
    if get_origin(hint) not in (list, Sequence, tuple):
        return None
    return get_args(hint)[0]


def tagged_types(hint: Any) -> dict[str, Any]:
    """Returns the dataclasses that a hint allows, by their tags.

    Of one tag it is the package's own, or the one that was made last.
    """
    found = [each for each in allowed_types(hint) if is_dataclass(each)]
    own = [each for each in found if each.__module__.startswith("vcbf_drake.")]
    return {tag_of(each): each for each in (*found, *own)}


def tag_of(schema: Any) -> str:
    """Returns a class's tag: ``!Car`` for a CarVehicle, ``!Box`` for a BoxObstacle."""
    name = re.sub("(Vehicle|Obstacle)$", "", schema.__name__)
    return str(getattr(schema, "TAG", f"!{name}"))


def field_types(schema: Any) -> dict[str, Any]:
    """Returns the types of a dataclass's fields."""
    hints = get_type_hints(schema)
    return {each.name: hints[each.name] for each in fields(schema)}


def build(node: Node, hint: Any, path: KeyPath) -> Any:
    """Returns what a type hint asks for; only whole numbers may become floats."""
    classes, (first, *others) = tagged_types(hint), allowed_types(hint)
    if types.NoneType in others and shown(node) == "nothing":
        return None
    if is_dataclass(first) or (classes and isinstance(node, yaml.MappingNode)):
        needs_tag = inspect.isabstract(hint)
        return _build_object(node, classes, path, needs_tag)
    if node.tag.startswith("!"):
        fail(node, path, f"tag {node.tag}; no tag is expected here")
    if (item := item_type(first)) is not None:
        if not isinstance(node, yaml.SequenceNode):
            fail(node, path, f"expected a list, got {shown(node)}")
        made = [build(each, item, (*path, i)) for i, each in enumerate(node.value)]
        if get_origin(first) is not tuple:
            return made
        size = len(get_args(first))
        if Ellipsis not in get_args(first) and len(made) != size:
            fail(node, path, f"expected {size} values, got {len(made)}")
        return tuple(made)
    return _build_scalar(node, first if first in TYPE_WORDS else str, path)


def _build_object(
    node: Node, classes: Mapping[str, Any], path: KeyPath, needs_tag: bool
) -> Any:
    tag, (first, *others) = node.tag, classes
    guess = ""
    if not tag.startswith("!"):
        if needs_tag:
            fail(node, path, f"its tag is missing; allowed: {', '.join(classes)}")
        tag = first
        guess = f" (no tag, so read as {first}; or {', '.join(others)})" * bool(others)
    if tag not in classes:
        fail(node, path, f"unknown tag {tag}; {did_you_mean(tag, classes)}")
    schema, values = classes[tag], {}
    hints = field_types(schema)
    for name, (key, value) in entries_of(node, path).items():
        if name not in hints:
            advice = did_you_mean(name, hints)
            if name in getattr(schema, "MOVED", {}):
                advice = f"it is {schema.MOVED[name]} now"
            fail(key, (*path, name), f"unknown key{guess}; {advice}")
        values[name] = build(value, hints[name], (*path, name))
    for each in fields(schema):
        if names_file(each) and each.name in values:
            written_in = directory_of(entries_of(node)[each.name][1].start_mark)
            values[each.name] = resolved(values[each.name], written_in)
        needed = each.default is each.default_factory is MISSING
        if needed and each.name not in values:
            fail(node, (*path, each.name), f"missing{guess}")
    with below(*path):
        return schema(**values)


def _build_scalar(node: Node, kind: Any, path: KeyPath) -> float | int | bool | str:
    """Returns the scalar; quoted means text, and unquoted numbers are not text."""
    text, is_plain = node.value, getattr(node, "style", "") is None
    is_text = node.tag.endswith(":str") or not is_plain
    try:
        if kind is str and is_text and isinstance(text, str):
            return text
        if kind is bool and is_plain:
            return bool(yaml.SafeLoader.bool_values[text.lower()])
        if kind in (int, float) and is_plain:
            # YAML 1.1 takes 1e-3 for text; .inf and .nan are its own.
            number = kind(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
            if _LARGEST < abs(number) < math.inf:
                rule = f"it must be at most {_LARGEST:g} in size"
                fail(node, path, f"{text[:99]}; {rule}")
            return cast(float, number)
    except (KeyError, ValueError):
        pass
    is_angle = kind is float and isinstance(text, str) and _ANGLE.search(text.lower())
    hint = "; angles are plain numbers, in radians: 1.5708 for 90 degrees"
    found = shown(node) + hint * bool(is_angle)
    fail(node, path, f"expected {TYPE_WORDS[kind]}, got {found}")


def plain(value: Any, hint: Any) -> Any:
    """Returns what YAML can hold; a member of a union has its tag."""
    if is_dataclass(value):
        hints, tags = field_types(type(value)), tagged_types(hint)
        data = {key: plain(getattr(value, key), hints[key]) for key in hints}
        data |= {
            each.name: resolved(data[each.name], Path())
            for each in fields(value)
            if names_file(each)
        }
        is_one_of = len(tags) > 1 or inspect.isabstract(hint)
        return {"_tag": tag_of(type(value)), **data} if is_one_of else data
    if isinstance(value, list | tuple | np.ndarray):
        item = item_type(allowed_types(hint)[0])
        return [plain(each, item) for each in value]
    return value.item() if isinstance(value, np.generic) else value
