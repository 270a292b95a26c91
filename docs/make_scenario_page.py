"""Makes the tables of docs/guide/scenarios.md anew from the JSON schema of scenarios.

python -m docs.make_scenario_page
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import re
from typing import Any

from vcbf_drake import plants
from vcbf_drake.plants.vehicle import channels_of
from vcbf_drake.simulation import scenario_schema

PAGE = Path(__file__).parent / "guide" / "scenarios.md"
MARK = "<!-- generated -->\n"
WORDS = {
    "number": "number",
    "integer": "whole number",
    "boolean": "true or false",
    "string": "text",
    "null": "null",
}
SHOWN = {"None": "null", "True": "true", "False": "false"}


def scenario_page() -> str:
    """Returns every key of a scenario file with unit, default and meaning: Markdown."""
    definitions = scenario_schema()["$defs"]
    return "\n".join(
        line
        for name, each in definitions.items()
        if name not in ("PartOfScenario", "Fleet")  # The same keys, all or more.
        for line in lines(each, name, definitions)
    )


def lines(
    section: dict[str, Any], name: str, definitions: dict[str, Any]
) -> Iterator[str]:
    """Yields the lines of one kind of mapping."""
    yield f"## {section['title']}\n\n{section['description']}\n"
    vehicle = getattr(plants, name, None)
    if name.endswith("Vehicle") and not section["required"]:
        channels = channels_of(vehicle().make_plant())
        for kind in ("states", "inputs", "disturbances"):
            named = getattr(channels, kind).items()
            listed = ", ".join(f"{each} [{unit}]" for each, unit in named)
            yield f"* {kind}, in this order: {listed}"
        yield ""
    yield "| key | type | unit | default | meaning |"
    yield "| --- | --- | --- | --- | --- |"
    for key, each in section["properties"].items():
        text = each["description"]
        unit = re.search(r" \[([^][]+)\]", text)
        text = text.replace(unit[0], "", 1) if unit else text
        default = str(each.get("default", ""))
        default = SHOWN.get(default, default)
        if key in section["required"]:
            default = "**required**"
        kind = in_words(each, definitions)
        cells = (f"`{key}`", kind, unit[1] if unit else "", default, text)
        yield f"| {' | '.join(each.replace('|', '&#124;') for each in cells)} |"
    yield ""


def in_words(schema: dict[str, Any], definitions: dict[str, Any]) -> str:
    """Returns a type in words, mappings as links."""
    if "anyOf" in schema:
        return " or ".join(in_words(each, definitions) for each in schema["anyOf"])
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        title = definitions[name]["title"].removeprefix("!")
        return f"[{title}](#{title.lower()})"
    if "enum" in schema:
        return ", ".join(f"`{word}`" for word in schema["enum"])
    if schema["type"] == "array":
        return f"list of {in_words(schema['items'], definitions)}"
    return WORDS[schema["type"]]


if __name__ == "__main__":
    head, _ = PAGE.read_text().split(MARK)
    PAGE.write_text(head + MARK + scenario_page())
