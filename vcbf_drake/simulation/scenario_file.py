"""Scenario files: strict loading of YAML, with the place of every mistake.

The text is composed into YAML nodes, which remember their file and line; overrides
are merged node by node; `build` turns the result into dataclasses. The conventions
are those of ``pydrake.common.yaml``, which reads and writes the same files: a tag
selects a member of a union, the first member needs none, and a key at the top level
that begins with an underscore is a template.
"""

from __future__ import annotations

from collections.abc import Mapping
import difflib
import math
from pathlib import Path
from typing import Any, cast

from pydrake.common.yaml import yaml_dump_typed
import yaml

from vcbf_drake.errors import ScenarioError
from vcbf_drake.simulation.invalid_field import InvalidFieldError
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.validation import validate
from vcbf_drake.simulation.yaml_nodes import (
    Node,
    compose,
    compose_overrides,
    locate,
    merge,
    put_on_one_line,
)
from vcbf_drake.simulation.yaml_values import build, did_you_mean

_DIRECTORY = Path(__file__).parent / "scenarios"


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
    name, node = _select(compose(text, source), source, scenario_name)
    if overrides is not None:
        node = merge(node, compose_overrides(overrides))
    try:
        scenario = cast(Scenario, build(node, Scenario))
        scenario.name = scenario.name or name
        validate(scenario)
    except InvalidFieldError as error:
        raise ScenarioError(f"{locate(node, error.path)}: {error}") from None
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
    node, *others = (compose_overrides(each) for each in overrides)
    for other in others:
        node = merge(node, other)
    put_on_one_line(node)
    text: str = yaml.serialize(node, Dumper=yaml.SafeDumper, width=math.inf)
    return text.strip()


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
