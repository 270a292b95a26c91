"""YAML's nodes, which remember where they were written: composed, merged, located."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import difflib
from functools import reduce
import math
from pathlib import Path
from textwrap import shorten
from typing import Any, TypeAlias, cast

from pydrake.common.yaml import yaml_dump
import yaml

from vcbf_drake.errors import Path as KeyPath, ScenarioError

Node: TypeAlias = Any  # A yaml.Node; PyYAML has no type stubs.
_OVERRIDE = "override"


def merge_overrides(*overrides: str | Mapping[str, Any]) -> str:
    """Returns overrides, of which the later win, as one line of YAML text.

    Raises:
        ScenarioError: One is not a mapping in YAML.
    """
    node = reduce(merged, map(compose, overrides))
    _put_on_one_line(node)
    text: str = yaml.serialize(node, Dumper=yaml.SafeDumper, width=math.inf)
    return text.strip()


def _put_on_one_line(node: Node) -> None:
    if isinstance(node, yaml.CollectionNode):
        node.flow_style = True
        for each in node.value:
            _put_on_one_line(each[1] if isinstance(each, tuple) else each)
    elif node.style in ("|", ">"):
        node.style = '"'


def did_you_mean(word: str, allowed: Iterable[str]) -> str:
    """Returns the close matches of a word, or what is allowed, on one line."""
    allowed = list(allowed)
    matches = difflib.get_close_matches(word, allowed, n=2)
    if matches:
        return f"did you mean {' or '.join(matches)}?"
    known = shorten(", ".join(allowed) or "none", 300, placeholder=" and more")
    return f"allowed: {known}"


def compose(text: str | Mapping[str, Any], source: str = _OVERRIDE) -> Node:
    """Returns the mapping that a text holds, or a mapping's own.

    Raises:
        ScenarioError: It is not YAML, or no mapping.
    """
    try:
        loader = yaml.SafeLoader(text if isinstance(text, str) else yaml_dump({**text}))
        loader.name = source
        node = loader.get_single_node()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = _where(mark) if mark else source
        reason = getattr(error, "problem", None) or " ".join(str(error).split())
        raise ScenarioError(f"{place}: not YAML: {reason}") from None
    if not isinstance(node, yaml.MappingNode):
        raise ScenarioError(f"{source}: expected a mapping, got {shown(node)}")
    return node


def entries_of(node: Node) -> dict[str, tuple[Node, Node]]:
    """Returns a mapping's keys and values by name, merge keys (``<<``) resolved.

    Raises:
        ScenarioError: It, or what it merges, is no mapping of different words.
    """
    if not isinstance(node, yaml.MappingNode):
        raise _refusal(node, f"expected a mapping, got {shown(node)}")
    if not hasattr(node, "entries"):
        own: dict[str, tuple[Node, Node]] = {}
        shared: dict[str, tuple[Node, Node]] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise _refusal(key, f"{shown(key)} as a key; keys are words")
            if key.value in own:
                raise _refusal(key, f"{key.value}: given twice")
            if key.tag.endswith(":merge"):
                is_list = isinstance(value, yaml.SequenceNode)
                for each in reversed(value.value if is_list else [value]):
                    shared |= entries_of(each)
            else:
                own[key.value] = (key, value)
        node.entries = shared | own
    return cast(dict[str, tuple[Node, Node]], node.entries)


def merged(base: Node, top: Node) -> Node:
    """Returns the base with the top's values; untagged mappings merge, others replace.

    Of a list, a mapping replaces the entries that its keys number. A node remembers
    where it was written, so later messages name the right source.
    """
    is_list = isinstance(base, yaml.SequenceNode) and isinstance(top, yaml.MappingNode)
    if is_list and all(name.isdigit() for name in entries_of(top)):
        values = [*base.value]
        for name, (key, value) in entries_of(top).items():
            if int(name) >= len(values):
                rule = f"they are 0 to {len(values) - 1}"
                raise _refusal(key, f"{name} is no entry; {rule}")
            values[int(name)] = merged(values[int(name)], value)
        return yaml.SequenceNode(base.tag, values, base.start_mark)
    both = isinstance(base, yaml.MappingNode) and isinstance(top, yaml.MappingNode)
    if not both or top.tag.startswith("!"):
        return top
    entries = dict(entries_of(base))
    for name, (key, value) in entries_of(top).items():
        old = entries.get(name)
        entries[name] = (key, merged(old[1], value) if old else value)
    return yaml.MappingNode(base.tag, [*entries.values()], base.start_mark)


def locate(node: Node, path: KeyPath) -> str:
    """Returns the place of the deepest node on the path that was written down."""
    mark = node.start_mark
    for part in path:
        if isinstance(node, yaml.SequenceNode) and isinstance(part, int):
            node = node.value[part]
            mark = node.start_mark
        elif isinstance(node, yaml.MappingNode) and part in entries_of(node):
            key, node = entries_of(node)[str(part)]
            mark = key.start_mark
    return _where(mark)


def directory_of(node: Node) -> Path:
    """The base of relative paths: the directory of a file, or of an override."""
    source = node.start_mark.name
    return Path() if source == _OVERRIDE else Path(source).parent


def _where(mark: Any) -> str:
    # An override is short, and what a program made has no lines.
    has_lines = mark.name != _OVERRIDE and not mark.name.endswith(".py")
    return f"{mark.name}:{mark.line + 1}" if has_lines else str(mark.name)


def _refusal(node: Node, problem: str) -> ScenarioError:
    return ScenarioError(f"{_where(node.start_mark)}: {problem}")


def shown(node: Node) -> str:
    """Returns the text of a node for messages."""
    if isinstance(node, yaml.CollectionNode):
        return "a list" if isinstance(node, yaml.SequenceNode) else "a mapping"
    if node is None or (node.style is None and node.value in ("", "~", "null")):
        return "nothing"
    return repr(node.value if len(node.value) <= 40 else node.value[:37] + "...")
