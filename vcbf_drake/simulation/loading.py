"""Scenario files: strict loading of YAML, with the place of every mistake.

PyYAML composes a text into nodes, which remember their place; overrides are merged node
by node; dataclasses are made of them by their type hints, and check themselves. As for
``pydrake.common.yaml``, a tag selects a member of a union, the first member needs none,
and a key at the top level that begins with an underscore is a template.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
import difflib
from functools import reduce
import inspect
import math
from pathlib import Path
import re
from textwrap import shorten
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

import numpy as np
from pydrake.common.yaml import yaml_dump
import yaml

from vcbf_drake.errors import (
    InvalidValueError,
    Path as KeyPath,
    ScenarioError,
    below,
    written,
)
from vcbf_drake.files import names_file, resolved
from vcbf_drake.simulation.fleet import Fleet
from vcbf_drake.simulation.python_file import scenario_of
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.typed import TYPE_WORDS, typed

Node: TypeAlias = Any  # A yaml.Node; PyYAML has no type stubs.

_DIRECTORY = Path(__file__).parent / "scenarios"
_OVERRIDE, VEHICLES = "override", "vehicles"
# What people write for an angle: 90deg, 90°, pi/2.
_ANGLE = re.compile(r"\d *(deg|°)|\bpi\b|\brad\b")
# No quantity is as large, in SI units; a product of a few such numbers is still finite.
_LARGEST = 1e15


def shipped_scenarios() -> tuple[str, ...]:
    """Returns the names of the scenarios that come with the package."""
    return tuple(sorted(path.stem for path in _DIRECTORY.glob("*.yaml")))


def scenario_path(name_or_path: str | Path) -> Path:
    """Returns the file of a shipped scenario's name, or the path as it is.

    Raises:
        ScenarioError: There is neither.
    """
    path, shipped = Path(name_or_path), shipped_scenarios()
    if str(name_or_path) in shipped:
        return _DIRECTORY / f"{name_or_path}.yaml"
    if not path.exists():
        raise ScenarioError(
            f"{path}: neither a file nor a shipped scenario ({', '.join(shipped)});"
            f" {did_you_mean(str(path), shipped)}"
        )
    return path


@typed
def load_scenario(
    name_or_path: str | Path,
    overrides: str | Mapping[str, Any] | None = None,
    scenario_name: str | None = None,
) -> Scenario:
    """Loads one scenario of one vehicle.

    Args:
        name_or_path: A shipped scenario's name; a YAML file whose top-level keys are
            scenario names; or a Python file with a function ``scenario()``.
        overrides: Values that replace those of the file, as YAML text or as a
            mapping. Mappings merge, a mapping of whole numbers replaces those entries
            of a list; lists, numbers and tagged mappings replace (in a Python mapping
            the key ``_tag`` holds the tag, with its ``!``).
        scenario_name: Which top-level key to load; needed when there are several.

    Raises:
        ScenarioError: One line that says where (file, line, key), what was found and
            what is allowed.
    """
    return only_one(load_fleet(name_or_path, overrides, scenario_name), name_or_path)


@typed
def load_fleet(
    name_or_path: str | Path,
    overrides: str | Mapping[str, Any] | None = None,
    scenario_name: str | None = None,
) -> Fleet:
    """Loads one scenario of one or several vehicles.

    The key ``vehicles`` of the latter is a list of scenarios, each with the entries
    beside it as its own, but for those that it gives itself.

    Args:
        name_or_path: See `load_scenario`.
        overrides: See `load_scenario`.
        scenario_name: See `load_scenario`.

    Raises:
        ScenarioError: See `load_scenario`.
    """
    path = scenario_path(name_or_path)
    if path.suffix == ".py":
        made = scenario_of(path)
        fleet = made if isinstance(made, Fleet) else Fleet.of(made)
        if overrides is None:
            return fleet
        return _parse(dump_fleet(fleet), str(path), overrides)
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ScenarioError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ScenarioError(f"{path}: not a UTF-8 text file") from None
    return _parse(text, str(path), overrides, scenario_name)


def parse_scenario(
    text: str, source: str, overrides: str | Mapping[str, Any] | None = None
) -> Scenario:
    """Returns the scenario of a YAML text from `source`; see `load_scenario`."""
    return only_one(_parse(text, source, overrides), source)


def only_one(fleet: Fleet, source: str | Path) -> Scenario:
    """Returns the scenario of a fleet's only vehicle.

    Raises:
        ScenarioError: It has several, as the source says.
    """
    if len(fleet.vehicles) > 1:
        names = ", ".join(each.name for each in fleet.vehicles)
        raise ScenarioError(
            f"{source}: {len(fleet.vehicles)} vehicles ({names}), where one is needed"
        )
    return fleet.vehicles[0]


def _parse(
    text: str,
    source: str,
    overrides: str | Mapping[str, Any] | None = None,
    scenario_name: str | None = None,
) -> Fleet:
    try:
        node = _select(_compose(text, source), source, scenario_name)
        if overrides is not None:
            node = _merge(node, _compose(overrides))
        try:
            return _build_fleet(node)
        except InvalidValueError as error:
            place = f"{_locate(node, error.path)}: {written(error.path)}"
            raise ScenarioError(f"{place}: {error.problem}") from None
    except RecursionError:
        raise ScenarioError(f"{source}: nested too deeply") from None


def dump_scenario(scenario: Scenario) -> str:
    """Returns the whole scenario as YAML text that loads back to the same."""
    return cast(str, yaml_dump({scenario.name: plain(scenario, Scenario)}))


def dump_fleet(fleet: Fleet) -> str:
    """Returns a fleet as YAML text that loads back to the same."""
    if len(fleet.vehicles) == 1:
        return dump_scenario(fleet.vehicles[0])
    vehicles = [plain(each, Scenario) for each in fleet.vehicles]
    return cast(str, yaml_dump({fleet.name: {VEHICLES: vehicles}}))


def merge_overrides(*overrides: str | Mapping[str, Any]) -> str:
    """Returns overrides, of which the later win, as one line of YAML text.

    Raises:
        ScenarioError: One is not a mapping in YAML.
    """
    node = reduce(_merge, map(_compose, overrides))
    _put_on_one_line(node)
    text: str = yaml.serialize(node, Dumper=yaml.SafeDumper, width=math.inf)
    return text.strip()


def did_you_mean(word: str, allowed: Iterable[str]) -> str:
    """Returns the close matches of a word, or what is allowed, on one line."""
    allowed = list(allowed)
    matches = difflib.get_close_matches(word, allowed, n=2)
    if matches:
        return f"did you mean {' or '.join(matches)}?"
    known = shorten(", ".join(allowed) or "none", 300, placeholder=" and more")
    return f"allowed: {known}"


# Nodes -----------------------------------------------------------------------------


def _compose(text: str | Mapping[str, Any], source: str = _OVERRIDE) -> Node:
    try:
        loader = yaml.SafeLoader(text if isinstance(text, str) else yaml_dump({**text}))
        loader.name = source
        node = loader.get_single_node()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise ScenarioError(f"{_where(mark)}: not YAML: {error.problem}") from None
    except yaml.YAMLError as error:
        reason = " ".join(str(error).split())
        raise ScenarioError(f"{source}: not YAML: {reason}") from None
    if not isinstance(node, yaml.MappingNode):
        raise ScenarioError(f"{source}: expected a mapping, got {_shown(node)}")
    return node


def _select(root: Node, source: str, name: str | None) -> Node:
    """Returns the node of a scenario, which then holds its name."""
    entries = {k: each for k, each in _entries(root).items() if k[:1] != "_"}
    problem = ""
    known = {*field_types(Scenario), *Scenario.MOVED, VEHICLES}
    if misplaced := [key for key in entries if key in known]:
        problem = f"{misplaced[0]} at the top; a scenario's name is missing above it"
    elif not entries:
        problem = "holds no scenario"
    elif name is None and len(entries) > 1:
        problem = f"holds {len(entries)} scenarios; scenario_name (--scenario-name)"
        problem += f" must be one of {', '.join(entries)}"
    elif name is not None and name not in entries:
        problem = f"no scenario {name!r}; {did_you_mean(name, entries)}"
    if problem:
        raise ScenarioError(f"{source}: {problem}")
    key, node = entries[name or next(iter(entries))]
    named, mark = _entries(node), key.start_mark
    text = yaml.ScalarNode("", key.value, mark, style='"')
    named.setdefault("name", (yaml.ScalarNode("", "name", mark), text))
    return node


def _entries(node: Node, path: KeyPath = ()) -> dict[str, tuple[Node, Node]]:
    """Returns a mapping's keys and values by name, merge keys (``<<``) resolved."""
    if not isinstance(node, yaml.MappingNode):
        _fail(node, path, f"expected a mapping, got {_shown(node)}")
    if not hasattr(node, "entries"):
        own: dict[str, tuple[Node, Node]] = {}
        merged: dict[str, tuple[Node, Node]] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                _fail(key, path, f"{_shown(key)} as a key; keys are words")
            if key.value in own:
                _fail(key, (*path, key.value), "given twice")
            if key.tag.endswith(":merge"):
                is_list = isinstance(value, yaml.SequenceNode)
                for each in reversed(value.value if is_list else [value]):
                    merged |= _entries(each, path)
            else:
                own[key.value] = (key, value)
        node.entries = merged | own
    return cast(dict[str, tuple[Node, Node]], node.entries)


def _merge(base: Node, top: Node) -> Node:
    """Returns the base with the top's values; untagged mappings merge, others replace.

    Of a list, a mapping replaces the entries that its keys number. A node remembers
    where it was written, so later messages name the right source.
    """
    is_list = isinstance(base, yaml.SequenceNode) and isinstance(top, yaml.MappingNode)
    if is_list and all(name.isdigit() for name in _entries(top)):
        values = [*base.value]
        for name, (key, value) in _entries(top).items():
            if int(name) >= len(values):
                _fail(key, (), f"{name} is no entry; they are 0 to {len(values) - 1}")
            values[int(name)] = _merge(values[int(name)], value)
        return yaml.SequenceNode(base.tag, values, base.start_mark)
    both = isinstance(base, yaml.MappingNode) and isinstance(top, yaml.MappingNode)
    if not both or top.tag.startswith("!"):
        return top
    merged = dict(_entries(base))
    for name, (key, value) in _entries(top).items():
        old = merged.get(name)
        merged[name] = (key, _merge(old[1], value) if old else value)
    return yaml.MappingNode(base.tag, [*merged.values()], base.start_mark)


def _put_on_one_line(node: Node) -> None:
    if isinstance(node, yaml.CollectionNode):
        node.flow_style = True
        for each in node.value:
            _put_on_one_line(each[1] if isinstance(each, tuple) else each)
    elif node.style in ("|", ">"):
        node.style = '"'


def _locate(node: Node, path: KeyPath) -> str:
    """Returns the place of the deepest node on the path that was written down."""
    mark = node.start_mark
    for part in path:
        if isinstance(node, yaml.SequenceNode) and isinstance(part, int):
            node = node.value[part]
            mark = node.start_mark
        elif isinstance(node, yaml.MappingNode) and part in _entries(node):
            key, node = _entries(node)[str(part)]
            mark = key.start_mark
    return _where(mark)


def _directory(mark: Any) -> Path:
    """What paths are relative to: where a file is, or where an override was written."""
    return Path() if mark.name == _OVERRIDE else Path(mark.name).parent


def _where(mark: Any) -> str:
    # An override is short, and what a program made has no lines.
    has_lines = mark.name != _OVERRIDE and not mark.name.endswith(".py")
    return f"{mark.name}:{mark.line + 1}" if has_lines else str(mark.name)


def _fail(node: Node, path: KeyPath, problem: str) -> NoReturn:
    place = filter(None, (_where(node.start_mark), written(path), problem))
    raise ScenarioError(": ".join(place))


def _shown(node: Node) -> str:
    if isinstance(node, yaml.CollectionNode):
        return "a list" if isinstance(node, yaml.SequenceNode) else "a mapping"
    if node is None or (node.style is None and node.value in ("", "~", "null")):
        return "nothing"
    text = repr(node.value if len(node.value) <= 40 else node.value[:37] + "...")
    return text if node.style is None else f"the text {text}"


# Values ----------------------------------------------------------------------------


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


def _build_fleet(node: Node) -> Fleet:
    """Returns the vehicles; those of a list share the entries beside it."""
    entries = dict(_entries(node))
    if VEHICLES not in entries:
        return Fleet.of(_build(node, Scenario, ()))
    _, listed = entries.pop(VEHICLES)
    _, name = entries.pop("name")
    if not isinstance(listed, yaml.SequenceNode):
        _fail(listed, (VEHICLES,), f"expected a list, got {_shown(listed)}")
    shared = yaml.MappingNode(node.tag, [*entries.values()], node.start_mark)
    vehicles = []
    for i, own in enumerate(listed.value):
        _entries(own, (VEHICLES, i))  # Nothing but a mapping.
        vehicles.append(_build(_merge(shared, own), Scenario, (VEHICLES, i)))
    return Fleet(name=name.value, vehicles=vehicles)


def _build(node: Node, hint: Any, path: KeyPath) -> Any:
    """Returns what a type hint asks for; only whole numbers may become floats."""
    classes, (first, *others) = tagged_types(hint), allowed_types(hint)
    if types.NoneType in others and _shown(node) == "nothing":
        return None
    if is_dataclass(first) or (classes and isinstance(node, yaml.MappingNode)):
        needs_tag = inspect.isabstract(hint)
        return _build_object(node, classes, path, needs_tag)
    if node.tag.startswith("!"):
        _fail(node, path, f"tag {node.tag}; no tag is expected here")
    if (item := item_type(first)) is not None:
        if not isinstance(node, yaml.SequenceNode):
            _fail(node, path, f"expected a list, got {_shown(node)}")
        made = [_build(each, item, (*path, i)) for i, each in enumerate(node.value)]
        if get_origin(first) is not tuple:
            return made
        size = len(get_args(first))
        if Ellipsis not in get_args(first) and len(made) != size:
            _fail(node, path, f"expected {size} values, got {len(made)}")
        return tuple(made)
    return _build_scalar(node, first if first in TYPE_WORDS else str, path)


def _build_object(
    node: Node, classes: Mapping[str, Any], path: KeyPath, needs_tag: bool
) -> Any:
    tag, (first, *others) = node.tag, classes
    guess = ""
    if not tag.startswith("!"):
        if needs_tag:
            _fail(node, path, f"its tag is missing; allowed: {', '.join(classes)}")
        tag = first
        guess = f" (no tag, so read as {first}; or {', '.join(others)})" * bool(others)
    if tag not in classes:
        _fail(node, path, f"unknown tag {tag}; {did_you_mean(tag, classes)}")
    schema, values = classes[tag], {}
    hints = field_types(schema)
    for name, (key, value) in _entries(node, path).items():
        if name not in hints:
            advice = did_you_mean(name, hints)
            if name in getattr(schema, "MOVED", {}):
                advice = f"it is {schema.MOVED[name]} now"
            _fail(key, (*path, name), f"unknown key{guess}; {advice}")
        values[name] = _build(value, hints[name], (*path, name))
    for each in fields(schema):
        if names_file(each) and each.name in values:
            written_in = _directory(_entries(node)[each.name][1].start_mark)
            values[each.name] = resolved(values[each.name], written_in)
        needed = each.default is each.default_factory is MISSING
        if needed and each.name not in values:
            _fail(node, (*path, each.name), f"missing{guess}")
    with below(*path):
        return schema(**values)


def field_types(schema: Any) -> dict[str, Any]:
    """Returns the types of a dataclass's fields."""
    hints = get_type_hints(schema)
    return {each.name: hints[each.name] for each in fields(schema)}


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
                _fail(node, path, f"{text[:99]}; {rule}")
            return cast(float, number)
    except (KeyError, ValueError):
        pass
    is_angle = kind is float and isinstance(text, str) and _ANGLE.search(text.lower())
    hint = "; angles are plain numbers, in radians: 1.5708 for 90 degrees"
    found = _shown(node) + hint * bool(is_angle)
    _fail(node, path, f"expected {TYPE_WORDS[kind]}, got {found}")


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
