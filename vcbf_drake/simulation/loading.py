"""Scenarios from YAML and Python files, with the place of every mistake, and back.

Objects are made of a text's nodes by their classes' type hints, and check themselves.
A tag selects a member of a union, and the first needs none. A top-level key of a file
is a scenario's name, or with ``_`` first a template.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import partial, reduce
import inspect
import math
from pathlib import Path
import re
from typing import Any, get_origin

from pydrake.common.yaml import yaml_dump
import yaml

from vcbf_drake import typed as types
from vcbf_drake.checks import did_you_mean, require
from vcbf_drake.errors import (
    InvalidValueError,
    Path as Keys,
    ScenarioError,
    below,
)
from vcbf_drake.files import names_file, read_text, resolved
from vcbf_drake.python_file import function_of, naming_place
from vcbf_drake.simulation.fleet import Fleet
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.yaml_nodes import (
    Node,
    changes,
    compose,
    entries_of,
    locate,
    merged,
    one_line,
    scalar_value,
)

VEHICLES = "vehicles"
_SHIPPED = {each.stem: each for each in Path(__file__).parent.glob("scenarios/*.yaml")}
_NUMERAL = re.compile(r"[-+.]?(\d|pi\b)", re.I)
_DECIMAL = "unquoted and decimal: 1.5708 for 90 degrees"
# No quantity is as large, in SI units; a product of a few such numbers is still finite.
_LARGEST = 1e15


def shipped_scenarios() -> tuple[str, ...]:
    """Returns the names of the scenarios that come with the package."""
    return tuple(sorted(_SHIPPED))


def scenario_path(name_or_path: str | Path) -> Path:
    """Returns the file of a shipped scenario's name, or the path as it is.

    Raises:
        ScenarioError: There is neither.
    """
    path = _SHIPPED.get(str(name_or_path), Path(name_or_path))
    if not path.exists():
        names = shipped_scenarios()
        allowed = f"allowed: {', '.join(names)}"
        hints = dict.fromkeys([allowed, did_you_mean(str(path), names)])
        problem = "neither a file nor a shipped scenario"
        raise ScenarioError(f"{path}: {'; '.join([problem, *hints])}")
    return path


@types.typed
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
            the key ``_tag`` holds the tag, with its ``!``). A key with dots reaches
            into mappings and lists, ``vehicle.mass`` for example. Files that they name
            are relative to the working directory.
        scenario_name: Which top-level key to load; needed when there are several.

    Raises:
        ScenarioError: One line that says where (file, line, key), what was found and
            what is allowed.
    """
    fleet = load_fleet(name_or_path, overrides, scenario_name)
    return fleet.only(name_or_path)


@types.typed
def load_fleet(
    name_or_path: str | Path,
    overrides: str | Mapping[str, Any] | None = None,
    scenario_name: str | None = None,
) -> Fleet:
    """Loads one scenario of one or several vehicles, as `load_scenario` does.

    The key ``vehicles`` of the latter is a list of scenarios, each with the entries
    beside it as its own, but for those that it gives itself.
    """
    path = scenario_path(name_or_path)
    if path.suffix != ".py":
        return _parse(read_text(path), str(path), overrides, scenario_name)
    make = function_of(path, "scenario")
    with naming_place(path):
        made = make()
        is_one = isinstance(made, Scenario | Fleet)
        require(is_one, "scenario()", made, "a vcbf_drake.Scenario or Fleet")
    made.name = made.name or path.stem
    if overrides is not None:
        return _parse(dump_scenario(made), str(path), overrides)
    return made if isinstance(made, Fleet) else Fleet.of(made)


def parse_scenario(
    text: str, source: str, overrides: str | Mapping[str, Any] | None = None
) -> Scenario:
    """Returns the scenario of a YAML text from `source`; see `load_scenario`."""
    return _parse(text, source, overrides).only(source)


def dump_scenario(scenario: Scenario | Fleet) -> str:
    """Returns the whole scenario as YAML text that loads back to the same."""
    made: Any = scenario
    if isinstance(made, Fleet) and len(made.vehicles) == 1:
        made = made.vehicles[0]
    text: str = yaml_dump({made.name: _plain(made, type(made))})
    return text


def merge_overrides(*overrides: str | Mapping[str, Any]) -> str:
    """Returns overrides, of which the later win, as one line of YAML text."""
    return one_line(reduce(merged, map(changes, overrides)))


def _parse(
    text: str,
    source: str,
    overrides: str | Mapping[str, Any] | None = None,
    scenario_name: str | None = None,
) -> Fleet:
    root = compose(text, source, "{name-of-the-scenario: {duration: 5}}")
    node = _select(root, source, scenario_name)
    try:
        if overrides is not None:
            node = merged(node, changes(overrides))
        entries = entries_of(node)
        if VEHICLES not in entries:
            fleet = Fleet.of(_build(node, Scenario))
        else:
            own = [entries.pop(key) for key in ("name", VEHICLES)]
            if own[1][1].id == "sequence":
                rest = [*entries.values()]
                shared = yaml.MappingNode(node.tag, rest, node.start_mark)
                # In place: a shared entry's mistake is located where it is written.
                own[1][1].value[:] = [merged(shared, each) for each in own[1][1].value]
            fleet = _build(yaml.MappingNode(node.tag, own, node.start_mark), Fleet)
    except InvalidValueError as error:
        raise ScenarioError(f"{locate(node, error.path)}: {error}") from None
    except RecursionError:
        raise ScenarioError(f"{source}: nested too deeply") from None
    fleet.locate = partial(locate, node)
    return fleet


def _select(root: Node, source: str, name: str | None) -> Node:
    """Returns the node of a scenario, whose key is its name where it gives none."""
    entries = {k: each for k, each in entries_of(root).items() if k[:1] != "_"}
    known = {VEHICLES, *types.field_types(Scenario)}
    for key in filter(known.__contains__, entries):
        problem = f"{key} at the top; a scenario's name is missing above it"
        raise ScenarioError(f"{source}: {problem}")
    chosen = next(iter(entries), None) if name is None and len(entries) == 1 else name
    if chosen not in entries:
        problem = f"holds {len(entries) or 'no'} scenarios; scenario_name"
        hint = did_you_mean(name or "", entries)
        raise ScenarioError(f"{source}: {problem} (--scenario-name) is {name}; {hint}")
    key, node = entries[chosen]
    if node.id == "mapping":
        node.value.insert(0, (yaml.ScalarNode("", "name", key.start_mark), key))
    return node


def _build(node: Node, hint: Any, path: Keys = ()) -> Any:
    """Returns the value of a node, of a given type."""
    classes, kinds = types.tagged_types(hint), types.allowed_types(hint)
    tag = node.tag if node.tag.startswith("!") else ""
    if tag not in classes and (tag or inspect.isabstract(hint)):
        problem = f"unknown tag {tag}" if tag else "its tag is missing"
        raise InvalidValueError(path, f"{problem}; {did_you_mean(tag, classes)}")
    if classes and node.id == "mapping":
        return _build_object(node, classes, tag, path)
    if node.id == "scalar" and not all(map(is_dataclass, kinds)):
        return _scalar(node, hint, path)
    is_list = node.id == "sequence"
    is_nested = is_list and any(each.id == "sequence" for each in node.value)
    item = types.item_of(kinds, is_nested)
    if is_list and item is not None:
        made = [_build(each, item, (*path, i)) for i, each in enumerate(node.value)]
        return tuple(made) if get_origin(kinds[0]) is tuple else made
    found = f"{node.value:.40}" if node.id == "scalar" else f"a {node.id}"
    rule = "a mapping" if classes else types.in_words(hint)
    raise InvalidValueError(path, f"{found or 'nothing'}; it must be {rule}")


def _build_object(node: Node, classes: Mapping[str, Any], tag: str, path: Keys) -> Any:
    first, *others = classes
    is_guess = f" (no tag, so read as {first}; or {', '.join(others)})"
    guess = is_guess if others and not tag else ""
    schema, values, entries = classes[tag or first], {}, entries_of(node)
    hints = types.field_types(schema)
    for name, (_, value) in entries.items():
        if name not in hints:
            moved = getattr(schema, "MOVED", {}).get(name)
            advice = f"it is {moved} now" if moved else did_you_mean(name, hints)
            raise InvalidValueError((*path, name), f"unknown key{guess}; {advice}")
        values[name] = _build(value, hints[name], (*path, name))
    for each in fields(schema):
        needed = each.default is each.default_factory is MISSING
        if needed and each.name not in values:
            raise InvalidValueError((*path, each.name), f"missing{guess}")
        if each.name in values and names_file(each):
            written_in = Path(entries[each.name][1].start_mark.name).parent
            values[each.name] = resolved(values[each.name], written_in)
    with below(*path):
        return schema(**values)


def _scalar(node: Node, hint: Any, path: Keys) -> Any:
    """Returns the value of a scalar, of a given type."""
    kind = types.allowed_types(hint)[0]
    value = scalar_value(node, kind)
    if isinstance(value, str) and kind in (float, int):
        is_numeral = _NUMERAL.match(value) is not None
        require(not is_numeral, path, value, f"{types.in_words(hint)}, {_DECIMAL}")
    elif isinstance(value, int | float):
        is_huge = _LARGEST < abs(value) < math.inf
        require(not is_huge, path, value, f"at most {_LARGEST:g} in size")
    types.check_type(path, value, hint)
    return value


def _plain(value: Any, hint: Any) -> Any:
    """Returns plain data for YAML; a member of a union has its tag."""
    if is_dataclass(value):
        kind: Any = type(value)
        hints = types.field_types(kind)
        data = {key: _plain(getattr(value, key), hints[key]) for key in hints}
        for each in filter(names_file, fields(value)):
            data[each.name] = resolved(data[each.name], Path())
        return data if kind is hint else {"_tag": types.tag_of(kind), **data}
    if isinstance(value, list | tuple):
        item = types.item_type(types.allowed_types(hint)[0])
        return [_plain(each, item) for each in value]
    return value.tolist() if hasattr(value, "tolist") else value  # Of an array.
