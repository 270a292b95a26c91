"""Scenarios from YAML and Python files, with the place of every mistake, and back.

A top-level key of a YAML file is a scenario's name, or with ``_`` first a template.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from pydrake.common.yaml import yaml_dump
import yaml

from vcbf_drake.checks import did_you_mean, require
from vcbf_drake.errors import InvalidValueError, ScenarioError
from vcbf_drake.files import read_text
from vcbf_drake.python_file import function_of, naming_place
from vcbf_drake.simulation.fleet import Fleet
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.yaml_nodes import (
    Node,
    build,
    compose,
    entries_of,
    locate,
    merged,
    plain,
)
from vcbf_drake.typed import field_types, typed

VEHICLES = "vehicles"
_FILES = sorted(Path(__file__).parent.glob("scenarios/*.yaml"))
_SHIPPED = {path.stem: path for path in _FILES}


def shipped_scenarios() -> tuple[str, ...]:
    """Returns the names of the scenarios that come with the package."""
    return tuple(_SHIPPED)


def scenario_path(name_or_path: str | Path) -> Path:
    """Returns the file of a shipped scenario's name, or the path as it is.

    Raises:
        ScenarioError: There is neither.
    """
    path = _SHIPPED.get(str(name_or_path), Path(name_or_path))
    if not path.exists():
        allowed = f"allowed: {', '.join(_SHIPPED)}"
        hints = dict.fromkeys([allowed, did_you_mean(str(path), _SHIPPED)])
        problem = "neither a file nor a shipped scenario"
        raise ScenarioError(f"{path}: {'; '.join([problem, *hints])}")
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
            the key ``_tag`` holds the tag, with its ``!``). Files that they name are
            relative to the working directory.
        scenario_name: Which top-level key to load; needed when there are several.

    Raises:
        ScenarioError: One line that says where (file, line, key), what was found and
            what is allowed.
    """
    fleet = load_fleet(name_or_path, overrides, scenario_name)
    return fleet.only(name_or_path)


@typed
def load_fleet(
    name_or_path: str | Path,
    overrides: str | Mapping[str, Any] | None = None,
    scenario_name: str | None = None,
) -> Fleet:
    """Loads one scenario of one or several vehicles, as `load_scenario` does.

    The key ``vehicles`` of the latter is a list of scenarios, each with the entries
    beside it as its own, but for those that it gives itself.

    Raises:
        ScenarioError: See `load_scenario`.
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
    text: str = yaml_dump({made.name: plain(made, type(made))})
    return text


def _parse(
    text: str,
    source: str,
    overrides: str | Mapping[str, Any] | None = None,
    scenario_name: str | None = None,
) -> Fleet:
    try:
        node = _select(compose(text, source), source, scenario_name)
        if overrides is not None:
            node = merged(node, compose(overrides))
        fleet = _build_fleet(node)
        fleet.locate = partial(locate, node)
        return fleet
    except InvalidValueError as error:
        raise ScenarioError(f"{locate(node, error.path)}: {error}") from None
    except RecursionError:
        raise ScenarioError(f"{source}: nested too deeply") from None


def _select(root: Node, source: str, name: str | None) -> Node:
    """Returns the node of a scenario, whose key is its name where it gives none."""
    entries = {k: each for k, each in entries_of(root).items() if k[:1] != "_"}
    known = {*field_types(Scenario), *Scenario.MOVED, VEHICLES}
    for key in filter(known.__contains__, entries):
        problem = f"{key} at the top; a scenario's name is missing above it"
        raise ScenarioError(f"{source}: {problem}")
    chosen = next(iter(entries), None) if name is None and len(entries) == 1 else name
    if chosen not in entries:
        problem = f"holds {len(entries) or 'no'} scenarios; scenario_name"
        hint = did_you_mean(name or "", entries)
        raise ScenarioError(f"{source}: {problem} (--scenario-name) is {name}; {hint}")
    key, node = entries[chosen]
    if isinstance(node, yaml.MappingNode):
        node.value.insert(0, (yaml.ScalarNode("", "name", key.start_mark), key))
    return node


def _build_fleet(node: Node) -> Fleet:
    """Returns the vehicles; those of a list share the entries beside it."""
    entries = entries_of(node)
    if VEHICLES not in entries:
        return Fleet.of(build(node, Scenario))
    own = [entries.pop(key) for key in ("name", VEHICLES)]
    if isinstance(listed := own[1][1], yaml.SequenceNode):
        shared = yaml.MappingNode(node.tag, [*entries.values()], node.start_mark)
        # In place: a mistake in a shared entry is located where that entry is written.
        listed.value[:] = [merged(shared, each) for each in listed.value]
    fleet: Fleet = build(yaml.MappingNode(node.tag, own, node.start_mark), Fleet)
    return fleet
