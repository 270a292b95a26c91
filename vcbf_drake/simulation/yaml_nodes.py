"""Dataclasses from YAML's nodes, which know where they were written, and back.

PyYAML composes a text into nodes; overrides are merged node by node; objects are made
of them by their classes' type hints, and check themselves. As for
``pydrake.common.yaml``, a tag selects a member of a union, and the first needs none.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import MISSING, fields, is_dataclass
from functools import reduce
import inspect
import math
from pathlib import Path
import re
from typing import Any, TypeAlias, get_origin

from pydrake.common.yaml import yaml_dump
import yaml
from yaml.constructor import SafeConstructor

from vcbf_drake.checks import did_you_mean, require
from vcbf_drake.errors import (
    InvalidValueError,
    Path as KeyPath,
    ScenarioError,
    below,
    written,
)
from vcbf_drake.files import names_file, resolved
from vcbf_drake.typed import (
    allowed_types,
    check_type,
    field_types,
    in_words,
    item_of,
    item_type,
    tag_of,
    tagged_types,
)

Node: TypeAlias = Any  # A yaml.Node; PyYAML has no type stubs.
_OVERRIDE = "override"
# The notations of an angle: 90deg, 90°, pi/2.
_ANGLE = re.compile(r"\d *(deg|°)|\bpi\b|\brad\b", re.IGNORECASE)
_RADIANS = "a number, in radians: 1.5708 for 90 degrees"
# YAML 1.1 reads 010 as 8 and 1:30 as 90.
_NOT_DECIMAL = re.compile(r"[-+]?0[0-7_]+|.*:.*")
# No quantity is as large, in SI units; a product of a few such numbers is still finite.
_LARGEST = 1e15


class _Loader(yaml.SafeLoader):
    """YAML of different words, merge keys (``<<``) resolved, on one line."""

    def compose_scalar_node(self, anchor: Any) -> Node:
        node = super().compose_scalar_node(anchor)
        node.style = '"' if "\n" in node.value else node.style
        return node

    def compose_mapping_node(self, anchor: Any) -> Node:
        node = super().compose_mapping_node(anchor)
        words: list[str] = []
        for key, _ in node.value:
            place = _where(key.start_mark)
            if not isinstance(key, yaml.ScalarNode):
                raise ScenarioError(f"{place}: a {key.id}; a key must be a word")
            if key.value in words:
                raise ScenarioError(f"{place}: {key.value:.40}: given twice")
            words.append(key.value)
        node.value = [(key, _first_of(key, value)) for key, value in node.value]
        self.flatten_mapping(node)
        node.value = [*entries_of(node).values()]
        return node


def _first_of(key: Node, value: Node) -> Node:
    """The mapping that a key merges; of a list, the first wins, as YAML says."""
    is_list = key.tag.endswith(":merge") and isinstance(value, yaml.SequenceNode)
    if not is_list or any(each.id != "mapping" for each in value.value):
        return value
    entries: dict[str, tuple[Node, Node]] = {}
    for each in reversed(value.value):
        entries |= entries_of(each)
    return yaml.MappingNode(value.tag, [*entries.values()], value.start_mark)


def compose(text: str | Mapping[str, Any], source: str = _OVERRIDE) -> Node:
    """Returns the mapping that a text holds, or that plain data are.

    Raises:
        ScenarioError: It is not YAML, or no mapping.
    """
    try:
        loader = _Loader(text if isinstance(text, str) else yaml_dump({**text}))
        loader.name = source
        node = loader.get_single_node()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = _where(mark) if mark else source
        reason = getattr(error, "problem", None) or " ".join(str(error).split())
        raise ScenarioError(f"{place}: not YAML: {reason}") from None
    if not isinstance(node, yaml.MappingNode):
        found = f"a {node.id}" if node else "nothing"
        example = ", such as {duration: 5}" if source == _OVERRIDE else ""
        raise ScenarioError(f"{source}: {found}; it must be a mapping{example}")
    return node


def merge_overrides(*overrides: str | Mapping[str, Any]) -> str:
    """Returns overrides, of which the later win, as one line of YAML text.

    Raises:
        ScenarioError: One is not a mapping in YAML.
    """
    node = reduce(merged, map(compose, overrides))
    node.flow_style = True
    text: str = yaml.serialize(node, Dumper=yaml.SafeDumper, width=math.inf)
    return text.strip()


def merged(base: Node, top: Node, path: KeyPath = ()) -> Node:
    """Returns the base with the top's values; untagged mappings merge, others replace.

    Of a list, a mapping replaces the entries that its keys number. A node remembers
    where it was written, so later messages name the right source.

    Raises:
        ScenarioError: There is no entry of a number.
    """
    is_mapping = isinstance(top, yaml.MappingNode) and not top.tag.startswith("!")
    if not is_mapping or isinstance(base, yaml.ScalarNode):
        return top
    is_list, entries = isinstance(base, yaml.SequenceNode), entries_of(base)
    for name, (key, value) in entries_of(top).items():
        _, old = entries.get(name, (None, None))
        if is_list and old is None:
            rule = f"it must be an entry of the list, 0 to {len(entries) - 1}"
            place = f"{_where(key.start_mark)}: {written((*path, name))}"
            raise ScenarioError(f"{place}: {name}; {rule}")
        entries[name] = (key, merged(old, value, (*path, name)) if old else value)
    values = [value if is_list else (key, value) for key, value in entries.values()]
    return type(base)(base.tag, values, base.start_mark)


def entries_of(node: Node) -> dict[str, tuple[Node, Node]]:
    """Returns keys and values of a mapping by name, the entries of a list by number."""
    if isinstance(node, yaml.SequenceNode):
        return {str(i): (each, each) for i, each in enumerate(node.value)}
    pairs = node.value if isinstance(node, yaml.MappingNode) else ()
    return {key.value: (key, value) for key, value in pairs}


def locate(node: Node, path: KeyPath) -> str:
    """Returns the place of the deepest node on the path that was written down."""
    key = node
    for part in path:
        key, node = entries_of(node).get(str(part), (key, None))
    return _where(key.start_mark)


def _where(mark: Any) -> str:
    # An override is short, and what a program made has no lines.
    has_lines = not mark.name.endswith((_OVERRIDE, ".py"))
    return f"{mark.name}:{mark.line + 1}" if has_lines else str(mark.name)


def build(node: Node, hint: Any, path: KeyPath = ()) -> Any:
    """Returns the value of a node, of a given type.

    Raises:
        InvalidValueError: It holds something else.
    """
    classes, kinds = tagged_types(hint), allowed_types(hint)
    tag = node.tag if node.tag.startswith("!") else ""
    if tag not in classes and (tag or inspect.isabstract(hint)):
        problem = f"unknown tag {tag}" if tag else "its tag is missing"
        needs_none = len(classes) == 1 and not inspect.isabstract(hint)
        advice = did_you_mean(tag, classes)
        if needs_none:
            advice = f"it needs none, or {', '.join(classes)}"
        raise InvalidValueError(path, f"{problem}; {advice}")
    if classes and isinstance(node, yaml.MappingNode):
        return _build_object(node, classes, tag, path)
    if isinstance(node, yaml.ScalarNode) and not all(map(is_dataclass, kinds)):
        value = _scalar(node, kinds[0], path)
        check_type(path, value, hint)
        return value
    is_list = isinstance(node, yaml.SequenceNode)
    is_nested = is_list and any(each.id == "sequence" for each in node.value)
    item = item_of(kinds, is_nested)
    if is_list and item is not None:
        made = [build(each, item, (*path, i)) for i, each in enumerate(node.value)]
        return tuple(made) if get_origin(kinds[0]) is tuple else made
    found = f"{node.value:.40}" if node.id == "scalar" else f"a {node.id}"
    rule = "a mapping" if classes else in_words(hint)
    raise InvalidValueError(path, f"{found or 'nothing'}; it must be {rule}")


def _build_object(
    node: Node, classes: Mapping[str, Any], tag: str, path: KeyPath
) -> Any:
    first, *others = classes
    is_guess = f" (no tag, so read as {first}; or {', '.join(others)})"
    guess = is_guess if others and not tag else ""
    schema, values, entries = classes[tag or first], {}, entries_of(node)
    hints = field_types(schema)
    for name, (_, value) in entries.items():
        place = (*path, name)
        if name not in hints:
            moved = getattr(schema, "MOVED", {}).get(name)
            advice = f"it is {moved} now" if moved else did_you_mean(name, hints)
            section, _, key = name.partition(".")
            if section in hints and key:
                advice = f"write {section}: {{{key}: ...}}"
            raise InvalidValueError(place, f"unknown key{guess}; {advice}")
        values[name] = build(value, hints[name], place)
    for each in fields(schema):
        needed = each.default is each.default_factory is MISSING
        if needed and each.name not in values:
            raise InvalidValueError((*path, each.name), f"missing{guess}")
        if each.name in values and names_file(each):
            written_in = Path(entries[each.name][1].start_mark.name).parent
            values[each.name] = resolved(values[each.name], written_in)
    with below(*path):
        return schema(**values)


def _scalar(node: Node, kind: Any, path: KeyPath) -> Any:
    """Returns a number, true or false, nothing or a text."""
    value: Any = node.value
    resolved_as = node.tag.rpartition(":")[2]
    if resolved_as in ("int", "float"):
        is_decimal = _NOT_DECIMAL.fullmatch(node.value) is None
        require(is_decimal, path, node.value, "a number in decimals: 90 for 1:30")
    with suppress(ValueError, TypeError, LookupError, OverflowError):
        if resolved_as in ("null", "bool", "int", "float"):
            value = SafeConstructor().construct_document(node)
        if kind is float and not (node.style or isinstance(value, bool)):
            value = float(value)  # YAML 1.1 takes 1e-3 for text.
    if isinstance(value, str):
        is_angle = kind is float and _ANGLE.search(value) is not None
        require(not is_angle, path, value, _RADIANS)
    elif value is not None:
        is_huge = _LARGEST < abs(value) < math.inf
        require(not is_huge, path, value, f"at most {_LARGEST:g} in size")
    return value


def plain(value: Any, hint: Any) -> Any:
    """Returns plain data for YAML; a member of a union has its tag."""
    if is_dataclass(value):
        kind: Any = type(value)
        hints = field_types(kind)
        data = {key: plain(getattr(value, key), hints[key]) for key in hints}
        for each in filter(names_file, fields(value)):
            data[each.name] = resolved(data[each.name], Path())
        return data if kind is hint else {"_tag": tag_of(kind), **data}
    if isinstance(value, list | tuple):
        item = item_type(allowed_types(hint)[0])
        return [plain(each, item) for each in value]
    return value.tolist() if hasattr(value, "tolist") else value  # Of an array.
