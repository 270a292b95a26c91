"""Scenario files and overrides: a scenario, or one line that says what is wrong."""

from __future__ import annotations

import dataclasses
from typing import get_args, get_type_hints

import atheris

with atheris.instrument_imports(include=["vcbf_drake.simulation", "yaml"]):
    from corpus import run

    from vcbf_drake import ScenarioError
    from vcbf_drake.simulation import loading
    from vcbf_drake.simulation.scenario import Scenario

_SHIPPED = {
    name: loading._find(name).read_text(encoding="utf-8")
    for name in loading.shipped_scenarios()
}
_SMALL = """\
s:
  vehicle: !Car {}
  input_set: {lower: [-1, -1], upper: [1, 1]}
  initial_state: [0, 0, 0, 0]
  target: [3, 0]
"""
_OVERRIDES = (
    "{duration: 3.0, period: .inf}",
    "{disturbance: [!Sinusoid {amplitude: [1.0]}, !Constant {value: [0.1]}]}",
    "{disturbance: [!BandLimitedNoise {std: [1.0], tones: 3, seed: 1}]}",
    "{disturbance: [!SmoothStep {amplitude: [1.0], start: 1.0, duration: 2.0}]}",
    "{disturbance: [!Recorded {times: [0, 1, 99], values: [[1], [2], [3]]}]}",
    "{input_set: {lower: [-1, -1], upper: [1, 1], A: [[1, 1]], b: [0.5]}}",
    "{faults: {gusts: [{amplitude: [1.0], start: 2.0}], sight: 1.0}}",
    "{obstacles: &o [{center: [1, 2], radius: 3}], target: [1e-3, -.inf]}",
    "{volume: {gain: slow, widening: 8}}",
    "{a: &a [*a], <<: {b: 1}, ? [c] : d}",
)


def _words() -> list[str]:
    """Keys, tags and values that get past the parser."""
    found, waiting = (
        {"*a", "&a", "<<:", "!!float", "!!python/object", ".nan"},
        [Scenario],
    )
    while waiting:
        schema = waiting.pop()
        for field in dataclasses.fields(schema):
            found.add(field.name)
            hint = get_type_hints(schema)[field.name]
            for inner in (hint, *get_args(hint)):
                for each in (inner, *get_args(inner)):
                    if (
                        dataclasses.is_dataclass(each)
                        and f"!{each.__name__}" not in found
                    ):
                        found.add(f"!{each.__name__}")
                        waiting.append(each)
    return sorted(found)


def target(data: bytes) -> None:
    text, name = data[1:].decode(errors="replace"), "fuzz.yaml"
    try:
        if data[:1] == b"f":
            scenario = loading.parse_scenario(text, name)
        else:
            scenario = loading.parse_scenario(_SMALL, name, text)
    except ScenarioError as error:
        assert str(error).isprintable(), "one line"
        return
    again = loading.parse_scenario(loading.dump_scenario(scenario), name)
    assert repr(again) == repr(scenario), "what was dumped loads to the same"


if __name__ == "__main__":
    files = [f"f{text}".encode() for text in (_SMALL, *_SHIPPED.values())]
    run(target, [*files, *(f"o{text}".encode() for text in _OVERRIDES)], _words())
