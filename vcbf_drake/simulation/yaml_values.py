"""build: a dataclass, and all below it, from YAML nodes and type hints."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import dataclasses
import difflib
import types
from typing import Any, Union, cast, get_args, get_origin, get_type_hints

import yaml

from vcbf_drake.simulation.invalid_field import KeyPath, ask
from vcbf_drake.simulation.yaml_nodes import Node, fail, shown


def build(node: Node, hint: Any, path: KeyPath = ()) -> Any:
    """Returns the value of a node as the type hint asks for it.

    Raises:
        ScenarioError: The node does not have the hinted type; nothing is converted,
            but an integer where a float is asked for.
    """
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return _build_union(node, get_args(hint), path)
    if dataclasses.is_dataclass(hint):
        return _build_dataclass(node, cast(type, hint), path)
    if node.tag.startswith("!"):
        fail(node, path, f"tag {node.tag}; no tag is expected here")
    if origin is list:
        if not isinstance(node, yaml.SequenceNode):
            fail(node, path, f"expected a list, got {shown(node)}")
        (item_hint,) = get_args(hint)
        return [
            build(item, item_hint, (*path, index))
            for index, item in enumerate(node.value)
        ]
    return _build_scalar(node, hint, path)


def _build_union(node: Node, members: Sequence[Any], path: KeyPath) -> Any:
    if types.NoneType in members and shown(node) == "nothing":
        return None
    if str in members and isinstance(node, yaml.ScalarNode):
        return _build_scalar(node, str, path)
    members = [each for each in members if each not in (types.NoneType, str)]
    if members[0] in _SCALARS:
        return build(node, members[0], path)
    by_tag = {f"!{member.__name__}": member for member in members}
    if node.tag.startswith("!"):
        if node.tag not in by_tag:
            fail(
                node, path, f"unknown tag {node.tag}; {did_you_mean(node.tag, by_tag)}"
            )
        return _build_dataclass(node, by_tag[node.tag], path)
    return _build_dataclass(node, members[0], path, alternatives=list(by_tag)[1:])


def _build_dataclass(
    node: Node, schema: type, path: KeyPath, alternatives: Sequence[str] = ()
) -> Any:
    # An untagged mapping that should have had a tag fails on its keys.
    hint = ""
    if alternatives:
        hint = f" (no tag, so read as !{schema.__name__}; or {', '.join(alternatives)})"
    if not isinstance(node, yaml.MappingNode):
        fail(node, path, f"expected a mapping, got {shown(node)}")
    if node.tag.startswith("!") and node.tag != f"!{schema.__name__}":
        fail(node, path, f"unknown tag {node.tag}; allowed: !{schema.__name__}")
    hints = get_type_hints(schema)
    fields = {field.name: field for field in dataclasses.fields(schema)}
    values = {}
    for key, value in node.value:
        if key.value not in fields:
            suggestion = did_you_mean(key.value, fields)
            fail(key, (*path, key.value), f"unknown key{hint}; {suggestion}")
        values[key.value] = build(value, hints[key.value], (*path, key.value))
    for name, field in fields.items():
        if name not in values and _is_required(field):
            fail(node, (*path, name), f"missing{hint}")
    return ask(lambda: schema(**values), schema, path)


def _is_required(field: dataclasses.Field[Any]) -> bool:
    has_default = (
        field.default is not dataclasses.MISSING
        or field.default_factory is not dataclasses.MISSING
    )
    return bool(field.metadata.get("required", not has_default))


_SPECIAL = {".inf": "inf", "+.inf": "inf", "-.inf": "-inf", ".nan": "nan"}
_SCALARS = {float: "a number", int: "a whole number", bool: "true or false"}


def _build_scalar(node: Node, hint: Any, path: KeyPath) -> Any:
    expected = _SCALARS.get(hint, "text")
    try:
        if isinstance(node, yaml.ScalarNode):
            return _parse(node, hint)
    except (ValueError, KeyError):
        pass
    fail(node, path, f"expected {expected}, got {shown(node)}")


def _parse(node: Node, hint: Any) -> float | int | bool | str:
    """Returns the scalar; quoted means text, and unquoted numbers are not text."""
    plain = node.style is None
    resolved = node.tag.removeprefix("tag:yaml.org,2002:")
    if hint is str and (not plain or resolved == "str"):
        return cast(str, node.value)
    if hint is bool and plain and resolved == "bool":
        return bool(yaml.SafeLoader.bool_values[node.value.lower()])
    if hint is int and plain:
        return int(node.value)
    if hint is float and plain:
        # YAML 1.1 takes 1e-3 for text; .inf and .nan are its own.
        return float(_SPECIAL.get(node.value.lower(), node.value))
    raise ValueError


def did_you_mean(word: str, allowed: Iterable[str]) -> str:
    """Returns the close matches of a word, or everything that is allowed."""
    allowed = list(allowed)
    matches = difflib.get_close_matches(word, allowed, n=2)
    if matches:
        return f"did you mean {' or '.join(matches)}?"
    return f"allowed: {', '.join(allowed) or 'none'}"
