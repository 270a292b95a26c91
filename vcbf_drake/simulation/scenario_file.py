"""Scenario files: strict loading of YAML, with the place of every mistake.

The text is composed into YAML nodes, which remember their file and line; overrides
are merged node by node; `build` turns the result into dataclasses. The conventions
are those of ``pydrake.common.yaml``, which reads and writes the same files: a tag
selects a member of a union, the first member needs none, and a key at the top level
that begins with an underscore is a template.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
import difflib
import math
from pathlib import Path
import types
from typing import (
    Any,
    NoReturn,
    TypeAlias,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from pydrake.common.yaml import yaml_dump, yaml_dump_typed
import yaml

from vcbf_drake.errors import ScenarioError
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.validation import (
    InvalidFieldError,
    KeyPath,
    ask,
    key_path,
    validate,
)

Node: TypeAlias = Any  # A yaml.Node; PyYAML has no type stubs.

_DIRECTORY = Path(__file__).parent / "scenarios"
_OVERRIDE = "override"
# A text of a few lines may stand for any number of values: aliases of aliases.
_MOST_VALUES = 1_000_000


def shipped_scenarios() -> tuple[str, ...]:
    """Returns the names of the scenarios that come with the package."""
    return tuple(sorted(path.stem for path in _DIRECTORY.glob("*.yaml")))


def load_scenario(
    name_or_path: str | Path,
    overrides: str | Mapping[str, Any] | None = None,
    scenario_name: str | None = None,
) -> Scenario:
    """Loads and validates one scenario.

    Args:
        name_or_path: A shipped scenario's name, or a YAML file whose top-level keys
            are scenario names.
        overrides: Values that replace those of the file, as YAML text or as a
            mapping. Mappings merge; lists, numbers and tagged mappings replace (in a
            Python mapping the key ``_tag`` holds the tag, with its ``!``).
        scenario_name: Which top-level key to load; needed when there are several.

    Raises:
        ScenarioError: One line that says where (file, line, key), what was found and
            what is allowed.
    """
    path = _find(str(name_or_path))
    return parse_scenario(_read(path), str(path), overrides, scenario_name)


def parse_scenario(
    text: str,
    source: str,
    overrides: str | Mapping[str, Any] | None = None,
    scenario_name: str | None = None,
) -> Scenario:
    """Returns the scenario of a YAML text, validated; see `load_scenario`.

    Args:
        text: What a scenario file holds.
        source: Where the text is from, for messages.
        overrides: As for `load_scenario`.
        scenario_name: As for `load_scenario`.

    Raises:
        ScenarioError: One line that says where, what was found and what is allowed.
    """
    name, node = _select(_compose(text, source), source, scenario_name)
    if overrides is not None:
        node = _merge(node, _compose_overrides(overrides))
    try:
        scenario = cast(Scenario, build(node, Scenario))
        scenario.name = scenario.name or name
        validate(scenario)
    except InvalidFieldError as error:
        raise ScenarioError(f"{_locate(node, error.path)}: {error}") from None
    return scenario


def dump_scenario(scenario: Scenario) -> str:
    """Returns the whole scenario as YAML text that loads back to the same."""
    return cast(str, yaml_dump_typed(scenario, child_name=scenario.name))


def merge_overrides(*overrides: str | Mapping[str, Any]) -> str:
    """Returns overrides, of which the later win, as one line of YAML text.

    Args:
        *overrides: Each as `load_scenario` takes it.

    Raises:
        ScenarioError: One is not a mapping in YAML.
    """
    node, *others = (_compose_overrides(each) for each in overrides)
    for other in others:
        node = _merge(node, other)
    _put_on_one_line(node)
    text: str = yaml.serialize(node, Dumper=yaml.SafeDumper, width=math.inf)
    return text.strip()


def did_you_mean(word: str, allowed: Iterable[str]) -> str:
    """Returns the close matches of a word, or everything that is allowed."""
    allowed = list(allowed)
    matches = difflib.get_close_matches(word, allowed, n=2)
    if matches:
        return f"did you mean {' or '.join(matches)}?"
    return f"allowed: {', '.join(allowed) or 'none'}"


# Files -----------------------------------------------------------------------------


def _find(name_or_path: str) -> Path:
    if name_or_path in shipped_scenarios():
        return _DIRECTORY / f"{name_or_path}.yaml"
    path = Path(name_or_path)
    if not path.exists():
        shipped = shipped_scenarios()
        matches = difflib.get_close_matches(name_or_path, shipped, n=1)
        raise ScenarioError(
            f"{name_or_path}: neither a file nor a shipped scenario"
            f" ({', '.join(shipped)})"
            + "".join(f"; did you mean {match}?" for match in matches)
        )
    return path


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ScenarioError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ScenarioError(f"{path}: not a UTF-8 text file") from None


def _select(root: Node, source: str, name: str | None) -> tuple[str, Node]:
    entries = {key.value: value for key, value in root.value if key.value[:1] != "_"}
    if not entries:
        raise ScenarioError(f"{source}: holds no scenario")
    if name is None and len(entries) == 1:
        return next(iter(entries.items()))
    if name is None:
        raise ScenarioError(
            f"{source}: holds {len(entries)} scenarios; scenario_name must be one of"
            f" {', '.join(entries)}"
        )
    if name not in entries:
        raise ScenarioError(
            f"{source}: no scenario {name!r}; {did_you_mean(name, entries)}"
        )
    return name, entries[name]


# Nodes -----------------------------------------------------------------------------


def _compose(text: str, source: str) -> Node:
    """Returns the root mapping's node; its marks carry the source's name."""
    try:
        loader = yaml.SafeLoader(text)
        loader.name = source
        root = loader.get_single_node()
        if not isinstance(root, yaml.MappingNode):
            raise ScenarioError(f"{source}: expected a mapping, got {_shown(root)}")
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


def _compose_overrides(overrides: str | Mapping[str, Any]) -> Node:
    if isinstance(overrides, str):
        return _compose(overrides, _OVERRIDE)
    try:
        return _compose(yaml_dump(dict(overrides)), _OVERRIDE)
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
            _fail(node, (), "contains itself")
        return counts[node]
    counts[node], values = 0, []
    if isinstance(node, yaml.SequenceNode):
        values = node.value
    elif isinstance(node, yaml.MappingNode):
        _check_keys(node)
        values = [value for _, value in node.value]
    count = 1 + sum(_flatten(value, loader, counts) for value in values)
    if count > _MOST_VALUES:
        _fail(node, (), f"stands for more than {_MOST_VALUES} values")
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
            _fail(key, (), f"{_shown(key)} as a key; keys are words")
        if key.value in seen:
            _fail(key, (key.value,), "given twice")
        seen.add(key.value)


def _merge(base: Node, top: Node) -> Node:
    """Returns the base with the top's values; untagged mappings merge, others replace.

    A node remembers where it was written, so later messages name the right source.
    """
    both = isinstance(base, yaml.MappingNode) and isinstance(top, yaml.MappingNode)
    if not both or top.tag.startswith("!"):
        return top
    merged = {key.value: (key, value) for key, value in base.value}
    for key, value in top.value:
        if key.value in merged:
            value = _merge(merged[key.value][1], value)
        merged[key.value] = (key, value)
    return yaml.MappingNode(
        base.tag, list(merged.values()), base.start_mark, base.end_mark
    )


def _put_on_one_line(node: Node) -> None:
    if isinstance(node, yaml.MappingNode):
        node.flow_style = True
        for _, value in node.value:
            _put_on_one_line(value)
    elif isinstance(node, yaml.SequenceNode):
        node.flow_style = True
        for item in node.value:
            _put_on_one_line(item)
    elif node.style in ("|", ">"):
        node.style = '"'


def _locate(node: Node, path: KeyPath) -> str:
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


def _fail(node: Node, path: KeyPath, problem: str) -> NoReturn:
    where = _where(node.start_mark)
    raise ScenarioError(": ".join(filter(None, (where, key_path(path), problem))))


def _shown(node: Node) -> str:
    if isinstance(node, yaml.SequenceNode):
        return "a list"
    if isinstance(node, yaml.MappingNode):
        return "a mapping"
    if node is None or (node.style is None and node.value in ("", "~", "null")):
        return "nothing"
    shown = repr(node.value if len(node.value) <= 40 else node.value[:37] + "...")
    return shown if node.style is None else f"the text {shown}"


# Values ----------------------------------------------------------------------------


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
        _fail(node, path, f"tag {node.tag}; no tag is expected here")
    if origin is list:
        if not isinstance(node, yaml.SequenceNode):
            _fail(node, path, f"expected a list, got {_shown(node)}")
        (item_hint,) = get_args(hint)
        return [
            build(item, item_hint, (*path, index))
            for index, item in enumerate(node.value)
        ]
    return _build_scalar(node, hint, path)


def _build_union(node: Node, members: Sequence[Any], path: KeyPath) -> Any:
    if types.NoneType in members and _shown(node) == "nothing":
        return None
    by_tag = {
        f"!{member.__name__}": member
        for member in members
        if member is not types.NoneType
    }
    if node.tag.startswith("!"):
        if node.tag not in by_tag:
            _fail(
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
        _fail(node, path, f"expected a mapping, got {_shown(node)}")
    if node.tag.startswith("!") and node.tag != f"!{schema.__name__}":
        _fail(node, path, f"unknown tag {node.tag}; allowed: !{schema.__name__}")
    hints = get_type_hints(schema)
    fields = {field.name: field for field in dataclasses.fields(schema)}
    values = {}
    for key, value in node.value:
        if key.value not in fields:
            suggestion = did_you_mean(key.value, fields)
            _fail(key, (*path, key.value), f"unknown key{hint}; {suggestion}")
        values[key.value] = build(value, hints[key.value], (*path, key.value))
    for name, field in fields.items():
        if name not in values and _is_required(field):
            _fail(node, (*path, name), f"missing{hint}")
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
    _fail(node, path, f"expected {expected}, got {_shown(node)}")


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
