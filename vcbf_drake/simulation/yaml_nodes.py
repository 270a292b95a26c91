"""YAML as nodes, which know where they were written, and merge.

PyYAML composes a text into nodes; its scalars are those of YAML 1.2. Overrides are
merged node by node, so that a mistake in either is located where it stands.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
import math
import re
from typing import Any, TypeAlias

from pydrake.common.yaml import yaml_dump
import yaml

from vcbf_drake.errors import Path as Keys, ScenarioError, written

OVERRIDE = "override"
Node: TypeAlias = Any  # A yaml.Node; PyYAML has no type stubs.
# The scalars of YAML 1.2: YAML 1.1 reads 010 as 8, 1:30 as 90 and 1e-3 as text.
_WORDS = {"": None, "~": None, "null": None, "true": True, "false": False}
_WHOLE = re.compile(r"[-+]?(0|[1-9]\d*)")
_NUMBER = re.compile(r"[-+]?((?!0\d)(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|\.inf|\.nan)", re.I)


class _Loader(yaml.SafeLoader):
    """YAML of different words, merge keys (``<<``) resolved, on one line."""

    def compose_scalar_node(self, anchor: Any) -> Node:
        node = super().compose_scalar_node(anchor)
        node.style = '"' if "\n" in node.value else node.style
        return node

    def compose_mapping_node(self, anchor: Any) -> Node:
        node = super().compose_mapping_node(anchor)
        own: dict[str, tuple[Node, Node]] = {}
        for key, value in node.value:
            if key.id != "scalar":
                raise ScenarioError(
                    f"{place_of(key)}: a {key.id}; a key must be a word"
                )
            if key.value in own:
                raise ScenarioError(f"{place_of(key)}: {key.value:.40}: given twice")
            own[key.value] = (key, value)
        _, shared = own.get("<<", (node, yaml.MappingNode("", [])))
        if shared.id != "mapping":
            problem = f"<<: a {shared.id}; it must be a mapping"
            raise ScenarioError(f"{place_of(shared)}: {problem}")
        entries = entries_of(shared) | own
        node.value = [entries[key] for key in entries if key != "<<"]
        return node


def changes(
    text: str | Mapping[str, Any],
    source: str = OVERRIDE,
    example: str = "{duration: 5}",
) -> Node:
    """Returns a mapping of changes; a key with dots reaches into sections and lists."""
    node = compose(text, source, example)
    root: Node = yaml.MappingNode(node.tag, [], node.start_mark)
    for name, (key, change) in entries_of(node).items():
        for word in reversed(name.split(".")):
            pair = yaml.ScalarNode(key.tag, word, key.start_mark), change
            change = yaml.MappingNode(node.tag, [pair], node.start_mark)
        both = merged(root, change)
        if _leaves(both) < _leaves(root) + _leaves(change):
            raise ScenarioError(f"{place_of(key)}: {name:.40}: given twice")
        root = both
    return root


def _leaves(node: Node) -> int:
    """The number of values in nested mappings."""
    is_section = node.id == "mapping"
    return sum(_leaves(each) for _, each in node.value) if is_section else 1


def compose(text: str | Mapping[str, Any], source: str, example: str) -> Node:
    """Returns the mapping that a text holds, or that plain data are."""
    try:
        loader = _Loader(text if isinstance(text, str) else yaml_dump({**text}))
        loader.name = source
        node = loader.get_single_node()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f"{source}:{mark.line + 1}" if mark and source != OVERRIDE else source
        reason = getattr(error, "problem", None) or " ".join(str(error).split())
        raise ScenarioError(f"{place}: not YAML: {reason}") from None
    except RecursionError:
        raise ScenarioError(f"{source}: nested too deeply") from None
    if not isinstance(node, yaml.MappingNode):
        found = f"a {node.id}" if node else "nothing"
        rule = f"it must be a mapping, such as {example}"
        raise ScenarioError(f"{source}: {found}; {rule}")
    return node


def merged(base: Node, top: Node, path: Keys = ()) -> Node:
    """Returns the base with the top's values; untagged mappings merge, others replace.

    Of a list, a mapping replaces the entries that its keys number.
    """
    if top.id != "mapping" or top.tag.startswith("!") or base.id == "scalar":
        return top
    is_list, entries = base.id == "sequence", entries_of(base)
    for name, (key, value) in entries_of(top).items():
        if is_list and name not in entries:
            rule = f"it must be an entry of the list, 0 to {len(entries) - 1}"
            where = f"{place_of(key)}: {written((*path, name))}"
            raise ScenarioError(f"{where}: {name}; {rule}")
        _, old = entries.get(name, (key, None))
        entries[name] = key, merged(old, value, (*path, name)) if old else value
    values = [value if is_list else (key, value) for key, value in entries.values()]
    return type(base)(base.tag, values, base.start_mark)


def entries_of(node: Node) -> dict[str, tuple[Node, Node]]:
    """Returns keys and values of a mapping by name, the entries of a list by number."""
    if isinstance(node, yaml.SequenceNode):
        return {str(i): (each, each) for i, each in enumerate(node.value)}
    pairs = node.value if isinstance(node, yaml.MappingNode) else ()
    return {key.value: (key, value) for key, value in pairs}


def locate(node: Node, path: Keys) -> str:
    """Returns the place of the deepest node on the path that was written down."""
    key = node
    for part in path:
        key, node = entries_of(node).get(str(part), (key, None))
    return place_of(key)


def place_of(node: Node) -> str:
    """Returns the file and the line where a node was written."""
    # An override is short, and what a program made has no lines.
    mark = node.start_mark
    has_lines = not mark.name.endswith((OVERRIDE, ".py"))
    return f"{mark.name}:{mark.line + 1}" if has_lines else str(mark.name)


def scalar_value(node: Node, kind: Any = None) -> Any:
    """Returns the number, true or false, nothing or text that a scalar is.

    Where a `float` is wanted, every number is one; elsewhere 1e3, which no program
    puts in quotes, is a text.
    """
    if node.style:
        return node.value
    word = node.value.lower()
    is_number = kind is float or node.tag.endswith((":int", ":float"))
    with suppress(ValueError):  # A whole number of thousands of digits.
        if _WHOLE.fullmatch(word) and kind is not float:
            return int(word)
        if _NUMBER.fullmatch(word) and is_number:
            return float(word.replace(".inf", "inf").replace(".nan", "nan"))
    return _WORDS.get(word, node.value)


def one_line(node: Node) -> str:
    """Returns YAML text of a node, on one line."""
    node.flow_style = True
    text: str = yaml.serialize(node, Dumper=yaml.SafeDumper, width=math.inf)
    return text.strip()
