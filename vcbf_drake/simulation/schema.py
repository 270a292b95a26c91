"""The scenario format as a JSON schema for editors, and as a page to read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
import inspect
import math
import re
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from vcbf_drake.plants import Vehicle
from vcbf_drake.plants.channels import channels_of
from vcbf_drake.simulation.loading import VEHICLES
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.yaml_values import (
    allowed_types,
    field_types,
    plain,
    tag_of,
    tagged_types,
)

_WORDS = {float: "number", int: "integer", bool: "boolean", str: "string"}
_KINDS = {
    float: "number",
    int: "whole number",
    bool: "true or false",
    str: "text",
    NoneType: "null",
}


def scenario_schema() -> dict[str, Any]:
    """Returns the JSON schema of a scenario file (draft 2020-12).

    A member of a union is a mapping with a tag, which JSON does not know: an editor has
    to be told the tags, for VS Code's YAML extension in ``yaml.customTags``, as
    ``"!Blimp mapping"``.
    """
    definitions = {
        schema.__name__: _object_schema(schema) for schema, _ in _all_classes()
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


def scenario_page() -> str:
    """Returns every key of a scenario file with unit, default and meaning: Markdown."""
    return "\n".join(
        line for schema, tag in _all_classes() for line in _lines(schema, tag)
    )


def descriptions(schema: type) -> dict[str, str]:
    """Returns what a dataclass's docstring, and its parents', say of its fields."""
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


def _all_classes() -> Iterator[tuple[type, str]]:
    """The dataclasses of a scenario, each once, the outer before the inner; tags."""
    waiting: list[tuple[Any, str]] = [(Scenario, "")]
    seen = set()
    while waiting:
        schema, tag = waiting.pop(0)
        if schema in seen:
            continue
        seen.add(schema)
        yield schema, tag
        for hint in field_types(schema).values():
            for inner in (hint, *get_args(hint)):
                tags = tagged_types(inner)
                is_union = len(tags) > 1 or inspect.isabstract(inner)
                waiting += [
                    (each, tag if is_union else "")
                    for tag, each in tags.items()
                    if _is_shipped(each)
                ]


def _is_shipped(kind: Any) -> bool:
    """Whether a type is no vehicle of somebody's Python file."""
    return not is_dataclass(kind) or kind.__module__.startswith("vcbf_drake.")


def _object_schema(schema: type) -> dict[str, Any]:
    texts, types = descriptions(schema), field_types(schema)
    properties = {}
    for each in fields(schema):
        properties[each.name] = {
            "description": texts.get(each.name, ""),
            **_type_schema(types[each.name]),
        }
        default = plain(_default(each), types[each.name])
        if default not in (MISSING, math.inf, -math.inf) and not isinstance(
            default, dict
        ):
            properties[each.name]["default"] = default
    return {
        "title": schema.__name__,
        "description": _summary(schema),
        "type": "object",
        "properties": properties,
        "required": [each.name for each in fields(schema) if not _has_default(each)],
        "additionalProperties": False,
    }


def _type_schema(hint: Any) -> dict[str, Any]:
    found = [_member_schema(each) for each in filter(_is_shipped, allowed_types(hint))]
    return found[0] if len(found) == 1 else {"anyOf": found}


def _member_schema(hint: Any) -> dict[str, Any]:
    if is_dataclass(hint):
        return {"$ref": f"#/$defs/{hint.__name__}"}  # type: ignore[union-attr]
    if get_origin(hint) in (list, Sequence):
        return {"type": "array", "items": _type_schema(*get_args(hint))}
    if get_origin(hint) is Literal:
        return {"enum": [*get_args(hint)]}
    return {"type": "null" if hint is NoneType else _WORDS[hint]}


def _has_default(each: Field[Any]) -> bool:
    return not each.default is each.default_factory is MISSING


def _default(each: Field[Any]) -> Any:
    if each.default_factory is not MISSING:
        return each.default_factory()
    return each.default


def _summary(schema: type) -> str:
    """The first paragraph of a class's docstring."""
    return " ".join((inspect.getdoc(schema) or "").split("\n\n")[0].split())


def _lines(schema: Any, tag: str) -> Iterator[str]:
    """A class as a section of the page."""
    title = tag or schema.__name__
    yield f"## {title}\n\n{_summary(schema)}\n"
    has_defaults = all(map(_has_default, fields(schema)))
    if issubclass(schema, Vehicle) and has_defaults:
        channels = channels_of(schema().make_plant())
        for kind in ("states", "inputs", "disturbances"):
            named = getattr(channels, kind).items()
            listed = ", ".join(f"{name} [{unit}]" for name, unit in named)
            yield f"* {kind}, in this order: {listed}"
        yield ""
    yield "| key | type | unit | default | what it is |"
    yield "| --- | --- | --- | --- | --- |"
    texts, types = descriptions(schema), field_types(schema)
    for each in fields(schema):
        text = texts.get(each.name, "")
        unit = re.search(r" \[([^][]+)\]", text)
        text = text.replace(unit[0], "", 1) if unit else text
        default = _shown(each, types[each.name]) if _has_default(each) else "**needed**"
        kind = _kind(types[each.name])
        cells = (f"`{each.name}`", kind, unit[1] if unit else "", default, text)
        yield f"| {' | '.join(cells).replace('|d', '&#124;d')} |"
    yield ""


def _kind(hint: Any) -> str:
    """A type in words, classes as links."""
    return " or ".join(map(_member_kind, filter(_is_shipped, allowed_types(hint))))


def _member_kind(hint: Any) -> str:
    if is_dataclass(hint):
        tag = tag_of(hint).removeprefix("!")
        return f"[{tag}](#{tag.lower()})"
    if get_origin(hint) in (list, Sequence):
        return f"list of {_kind(*get_args(hint))}"
    if get_origin(hint) is Literal:
        return ", ".join(f"`{word}`" for word in get_args(hint))
    return _KINDS[hint]


def _shown(each: Field[Any], hint: Any) -> str:
    value = plain(_default(each), hint)
    if isinstance(value, dict):
        return ""
    words = {"None": "null", "True": "true", "False": "false"}
    return words.get(str(value), str(value))
