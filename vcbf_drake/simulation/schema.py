"""The scenario format as a JSON schema, for editors."""

from __future__ import annotations

from dataclasses import MISSING, fields, is_dataclass
import inspect
import math
import re
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from vcbf_drake.simulation.loading import VEHICLES
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.typed import allowed_types, field_types, item_type, tagged_types

_WORDS = {
    float: "number",
    int: "integer",
    bool: "boolean",
    str: "string",
    NoneType: "null",
}


def scenario_schema() -> dict[str, Any]:
    """Returns the JSON schema of a scenario file (draft 2020-12).

    A member of a union is a mapping with a tag, its title here, which JSON does not
    know: an editor has to be told the tags, for VS Code's YAML extension in
    ``yaml.customTags``, as ``"!Blimp mapping"``.
    """
    definitions = {
        each.__name__: _object_schema(each, title) for each, title in _classes().items()
    }
    part = definitions["Scenario"] | {"required": []}
    vehicles = {"type": "array", "items": {"$ref": "#/$defs/PartOfScenario"}}
    fleet = part["properties"] | {VEHICLES: vehicles}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "vcbf_drake scenarios",
        "type": "object",
        "patternProperties": {"^_": {}},
        "additionalProperties": {
            "anyOf": [{"$ref": "#/$defs/Scenario"}, {"$ref": "#/$defs/Fleet"}]
        },
        "$defs": definitions
        | {
            "PartOfScenario": part,
            "Fleet": part | {"properties": fleet, "required": [VEHICLES]},
        },
    }


def _descriptions(schema: type) -> dict[str, str]:
    """Returns the descriptions of a dataclass's fields, from its docstrings."""
    found: dict[str, str] = {}
    for each in reversed(schema.__mro__):
        if not is_dataclass(each):
            continue
        _, _, section = (inspect.getdoc(each) or "").partition("Attributes:\n")
        section = re.split(r"\n\n|\n(?=\S)", section)[0]
        for match in re.finditer(
            r"^ {4}(\w+): (.*(?:\n {8}.*)*)", section, re.MULTILINE
        ):
            found[match[1]] = " ".join(match[2].split())
    return found


def _classes() -> dict[type, str]:
    """The dataclasses of a scenario, the outer before the inner, with their titles."""
    found: dict[type, str] = {}
    waiting: list[tuple[Any, str]] = [(Scenario, "Scenario")]
    while waiting:
        schema, title = waiting.pop(0)
        if schema in found:
            continue
        found[schema] = title
        for hint in field_types(schema).values():
            for inner in (hint, *get_args(hint)):
                tags = tagged_types(inner)
                is_union = len(tags) > 1 or inspect.isabstract(inner)
                waiting += [
                    (each, tag if is_union else each.__name__)
                    for tag, each in tags.items()
                    if _is_shipped(each)
                ]
    return found


def _is_shipped(kind: Any) -> bool:
    """Whether a type is no vehicle of somebody's Python file."""
    return not is_dataclass(kind) or kind.__module__.startswith("vcbf_drake.")


def _object_schema(schema: type, title: str) -> dict[str, Any]:
    texts, types = _descriptions(schema), field_types(schema)
    properties, required = {}, []
    for each in fields(schema):
        found = properties[each.name] = _type_schema(types[each.name])
        found["description"] = texts.get(each.name, "")
        default = each.default
        if each.default_factory is not MISSING:
            default = each.default_factory()
        if default is MISSING:
            required.append(each.name)
        elif not is_dataclass(default):
            infinite = {math.inf: ".inf", -math.inf: "-.inf"}
            is_infinite = isinstance(default, float) and default in infinite
            found["default"] = infinite[default] if is_infinite else default
            if isinstance(default, tuple):
                found["default"] = [*default]
    return {
        "title": title,
        "description": " ".join(
            (inspect.getdoc(schema) or "").split("\n\n")[0].split()
        ),
        "type": "object",
        "properties": properties,
        "required": required,
        "additionalProperties": False,
    }


def _type_schema(hint: Any) -> dict[str, Any]:
    found = [_member_schema(each) for each in filter(_is_shipped, allowed_types(hint))]
    return found[0] if len(found) == 1 else {"anyOf": found}


def _member_schema(hint: Any) -> dict[str, Any]:
    if is_dataclass(hint):
        return {"$ref": f"#/$defs/{hint.__name__}"}  # type: ignore[union-attr]
    if (item := item_type(hint)) is not None:
        return {"type": "array", "items": _type_schema(item)}
    if get_origin(hint) is Literal:
        return {"enum": [*get_args(hint)]}
    return {"type": _WORDS[hint]}
