"""Scenario files: strict loading of YAML, with the place of every mistake.

PyYAML composes a text into nodes, which remember their place; overrides are merged node
by node; dataclasses are made of them by their type hints, and check themselves. As for
``pydrake.common.yaml``, a tag selects a member of a union, the first member needs none,
and a key at the top level that begins with an underscore is a template.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from pydrake.common.yaml import yaml_dump
import yaml

from vcbf_drake.errors import InvalidValueError, ScenarioError
from vcbf_drake.files import read_text
from vcbf_drake.simulation.fleet import Fleet
from vcbf_drake.simulation.python_file import scenario_of
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.yaml_nodes import (
    Node,
    compose,
    did_you_mean,
    entries_of,
    locate,
    merged,
    shown,
)
from vcbf_drake.simulation.yaml_values import build, plain
from vcbf_drake.typed import field_types, typed

_DIRECTORY = Path(__file__).parent / "scenarios"
VEHICLES = "vehicles"


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
        names = f"allowed: {', '.join(shipped)}"
        guess = did_you_mean(str(path), shipped)
        hint = names if guess == names else f"{names}; {guess}"
        raise ScenarioError(f"{path}: neither a file nor a shipped scenario; {hint}")
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
    return _parse(read_text(path), str(path), overrides, scenario_name)


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
        node = _select(compose(text, source), source, scenario_name)
        if overrides is not None:
            node = merged(node, compose(overrides))
        return _build_fleet(node)
    except InvalidValueError as error:
        raise ScenarioError(f"{locate(node, error.path)}: {error}") from None
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


def _select(root: Node, source: str, name: str | None) -> Node:
    """Returns the node of a scenario, which then holds its name."""
    entries = {k: each for k, each in entries_of(root).items() if k[:1] != "_"}
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
    named, mark = entries_of(node), key.start_mark
    text = yaml.ScalarNode("", key.value, mark, style='"')
    named.setdefault("name", (yaml.ScalarNode("", "name", mark), text))
    return node


def _build_fleet(node: Node) -> Fleet:
    """Returns the vehicles; those of a list share the entries beside it."""
    entries = dict(entries_of(node))
    if VEHICLES not in entries:
        return Fleet.of(build(node, Scenario))
    _, listed = entries.pop(VEHICLES)
    _, name = entries.pop("name")
    if not isinstance(listed, yaml.SequenceNode):
        raise InvalidValueError(VEHICLES, f"expected a list, got {shown(listed)}")
    shared = yaml.MappingNode(node.tag, [*entries.values()], node.start_mark)
    # In place: a mistake in a shared entry is located where that entry is written.
    listed.value[:] = [merged(shared, own) for own in listed.value]
    vehicles = [
        build(each, Scenario, (VEHICLES, i)) for i, each in enumerate(listed.value)
    ]
    return Fleet(name=name.value, vehicles=vehicles)
