"""YAML nodes: what a text says and where it says it, merged and searched.

A node remembers its file and line, through every merge.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NoReturn, TypeAlias

from pydrake.common.yaml import yaml_dump
import yaml

from vcbf_drake.errors import ScenarioError
from vcbf_drake.simulation.invalid_field import KeyPath, key_path

Node: TypeAlias = Any  # A yaml.Node; PyYAML has no type stubs.

_OVERRIDE = "override"
# A text of a few lines may stand for any number of values: aliases of aliases.
_MOST_VALUES = 1_000_000


def compose(text: str, source: str) -> Node:
    """Returns the root mapping's node; its marks carry the source's name.

    Args:
        text: In YAML.
        source: Where it is from, for messages.

    Raises:
        ScenarioError: It is no mapping in YAML, or too large.
    """
    try:
        loader = yaml.SafeLoader(text)
        loader.name = source
        root = loader.get_single_node()
        if not isinstance(root, yaml.MappingNode):
            raise ScenarioError(f"{source}: expected a mapping, got {shown(root)}")
        _flatten(root, loader, {})
    except RecursionError:
        raise ScenarioError(f"{source}: nested too deeply") from None
    except yaml.MarkedYAMLError as error:
        where = _where(error.problem_mark or error.context_mark)
        raise ScenarioError(f"{where}: not YAML: {error.problem}") from None
    except yaml.YAMLError as error:
        reason = " ".join(str(error).split())
        raise ScenarioError(f"{source}: not YAML: {reason}") from None
    return root


def compose_overrides(overrides: str | Mapping[str, Any]) -> Node:
    """Returns the node of overrides, as YAML text or as a mapping.

    Raises:
        ScenarioError: They are no mapping in YAML, or too large.
    """
    if isinstance(overrides, str):
        return compose(overrides, _OVERRIDE)
    try:
        return compose(yaml_dump(dict(overrides)), _OVERRIDE)
    except yaml.YAMLError as error:
        raise ScenarioError(
            f"{_OVERRIDE}: cannot be written as YAML: {error}"
        ) from None


def _flatten(node: Node, loader: Any, counts: dict[Node, int]) -> int:
    """Resolves merge keys (``<<``) at every depth; returns how many values there are.

    Refuses keys given twice, nodes that contain themselves, and a text that stands for
    more than a million values.

    Args:
        node: The node.
        loader: What composed it.
        counts: The values of every node so far; 0 while they are still counted.
    """
    if node in counts:  # An alias.
        if not counts[node]:
            fail(node, (), "contains itself")
        return counts[node]
    counts[node], values = 0, []
    if isinstance(node, yaml.SequenceNode):
        values = node.value
    elif isinstance(node, yaml.MappingNode):
        _check_keys(node)
        values = [value for _, value in node.value]
    count = 1 + sum(_flatten(value, loader, counts) for value in values)
    if count > _MOST_VALUES:
        fail(node, (), f"stands for more than {_MOST_VALUES} values")
    if isinstance(node, yaml.MappingNode):
        loader.flatten_mapping(node)
        # Of a key that is merged more than once, the last one counts.
        node.value = list(
            {key.value: (key, value) for key, value in node.value}.values()
        )
    counts[node] = count
    return count


def _check_keys(node: Node) -> None:
    seen = set()
    for key, _ in node.value:
        if not isinstance(key, yaml.ScalarNode):
            fail(key, (), f"{shown(key)} as a key; keys are words")
        if key.value in seen:
            fail(key, (key.value,), "given twice")
        seen.add(key.value)


def merge(base: Node, top: Node) -> Node:
    """Returns the base with the top's values; untagged mappings merge, others replace.

    A node remembers where it was written, so later messages name the right source.
    """
    both = isinstance(base, yaml.MappingNode) and isinstance(top, yaml.MappingNode)
    if not both or top.tag.startswith("!"):
        return top
    merged = {key.value: (key, value) for key, value in base.value}
    for key, value in top.value:
        if key.value in merged:
            value = merge(merged[key.value][1], value)
        merged[key.value] = (key, value)
    return yaml.MappingNode(
        base.tag, list(merged.values()), base.start_mark, base.end_mark
    )


def put_on_one_line(node: Node) -> None:
    """Makes a node, and all below it, be written on one line."""
    if isinstance(node, yaml.MappingNode):
        node.flow_style = True
        for _, value in node.value:
            put_on_one_line(value)
    elif isinstance(node, yaml.SequenceNode):
        node.flow_style = True
        for item in node.value:
            put_on_one_line(item)
    elif node.style in ("|", ">"):
        node.style = '"'


def locate(node: Node, path: KeyPath) -> str:
    """Returns the place of the deepest node on the path that was written down."""
    mark = node.start_mark
    for part in path:
        if isinstance(node, yaml.SequenceNode) and isinstance(part, int):
            node = node.value[part]
            mark = node.start_mark
        elif isinstance(node, yaml.MappingNode):
            entries = {key.value: (key, value) for key, value in node.value}
            if part not in entries:
                break
            key, node = entries[part]
            mark = key.start_mark
    return _where(mark)


def _where(mark: Any) -> str:
    # An override is short, and a mapping has no lines.
    return _OVERRIDE if mark.name == _OVERRIDE else f"{mark.name}:{mark.line + 1}"


def fail(node: Node, path: KeyPath, problem: str) -> NoReturn:
    """Refuses a node, with its place.

    Raises:
        ScenarioError: Always.
    """
    where = _where(node.start_mark)
    raise ScenarioError(": ".join(filter(None, (where, key_path(path), problem))))


def shown(node: Node) -> str:
    """Returns what a node is, for a message."""
    if isinstance(node, yaml.SequenceNode):
        return "a list"
    if isinstance(node, yaml.MappingNode):
        return "a mapping"
    if node is None or (node.style is None and node.value in ("", "~", "null")):
        return "nothing"
    text = repr(node.value if len(node.value) <= 40 else node.value[:37] + "...")
    return text if node.style is None else f"the text {text}"
