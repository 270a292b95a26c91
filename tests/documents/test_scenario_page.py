"""The page of the scenario format, and its JSON schema, say what the program does."""

from __future__ import annotations

from dataclasses import fields
import json
from pathlib import Path
from typing import Any

from pydrake.common.yaml import yaml_load
import pytest

from docs.make_scenario_page import MARK, PAGE, scenario_page
from vcbf_drake.simulation import loading, scenario_schema, shipped_scenarios
from vcbf_drake.simulation.loading import load_scenario
from vcbf_drake.simulation.scenario import Scenario

ROOT = Path(__file__).parents[2]
SCENARIOS = Path(loading.__file__).parent / "scenarios"


def test_page_is_what_the_program_makes() -> None:
    _, generated = PAGE.read_text().split(MARK)
    assert generated == scenario_page(), "python -m docs.make_scenario_page"


def test_page_explains_every_key() -> None:
    rows = [line for line in scenario_page().splitlines() if line.startswith("| `")]
    assert len(rows) > 100
    for row in rows:
        assert len(row.split(" | ")[-1].rstrip(" |")) > 3, row


def test_page_gives_state_orders() -> None:
    order = "x [m], y [m], speed [m/s], heading [rad]"
    assert f"* states, in this order: {order}" in scenario_page()


def test_example_on_the_page_loads(tmp_path: Path) -> None:
    text = PAGE.read_text()
    path = tmp_path / "page.yaml"
    path.write_text(text.split("```yaml\n")[1].split("```")[0])
    assert load_scenario(path).name == "my-scenario"


@pytest.mark.parametrize("name", shipped_scenarios())
def test_shipped_scenarios_keep_to_the_schema(name: str) -> None:
    schema = json.loads(json.dumps(scenario_schema(), allow_nan=False))
    read = yaml_load(filename=str(SCENARIOS / f"{name}.yaml"), private=True)[name]
    check(read, {"$ref": "#/$defs/Scenario"}, schema["$defs"])


def test_vehicles_of_one_scenario_keep_to_the_schema() -> None:
    schema = json.loads(json.dumps(scenario_schema(), allow_nan=False))
    path = ROOT / "examples" / "two_vehicles.yaml"
    read = yaml_load(filename=str(path), private=True)
    check(read["crossing"], schema["additionalProperties"], schema["$defs"])
    with pytest.raises(AssertionError):
        del read["crossing"]["vehicles"]
        check(read["crossing"], schema["additionalProperties"], schema["$defs"])


def test_schema_refuses_what_the_loader_refuses() -> None:
    definitions = scenario_schema()["$defs"]
    scenario = definitions["Scenario"]
    assert not scenario["additionalProperties"]
    assert scenario["required"] == ["vehicle", "initial_state", "target"]
    assert set(scenario["properties"]) == {each.name for each in fields(Scenario)}
    assert scenario["properties"]["infeasible"]["enum"][0] == "stop"
    assert scenario["properties"]["duration"]["default"] == 20.0


def check(value: Any, schema: dict[str, Any], definitions: dict[str, Any]) -> None:
    """Checks a value against the few words of JSON Schema that we write."""
    if "$ref" in schema:
        schema = definitions[schema["$ref"].rpartition("/")[2]]
    if "anyOf" in schema:
        problems = []
        for each in schema["anyOf"]:
            try:
                return check(value, each, definitions)
            except AssertionError as error:
                problems.append(error)
        raise AssertionError(problems)
    if "enum" in schema:
        assert value in schema["enum"]
        return None
    kinds: dict[str, Any] = {
        "object": dict,
        "array": list,
        "number": (int, float),
        "integer": int,
        "boolean": bool,
        "string": str,
        "null": type(None),
    }
    assert isinstance(value, kinds[schema["type"]]), (value, schema)
    for item in value if schema["type"] == "array" else []:
        check(item, schema["items"], definitions)
    if schema["type"] == "object":
        given = {key: each for key, each in value.items() if key != "_tag"}
        assert set(schema["required"]) <= set(given) <= set(schema["properties"])
        for key, each in given.items():
            check(each, schema["properties"][key], definitions)
    return None
