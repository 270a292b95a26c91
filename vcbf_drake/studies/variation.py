"""Variations of a scenario: random values, drawn anew for every trial."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass
from functools import lru_cache
import hashlib
import math
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from vcbf_drake.errors import ScenarioError
from vcbf_drake.files import read_text
from vcbf_drake.python_file import function_of
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.simulation.yaml_nodes import (
    Node,
    changes,
    compose,
    entries_of,
    one_line,
    place_of,
    scalar_value,
)

Generator = np.random.Generator
_SOURCE = "variation"


class Draw(Protocol):
    """The base of random values that a study draws anew for every trial."""

    @property
    def name(self) -> str:
        """Its name in records; another draw has another name."""

    def draw(self, scenario: Scenario, seed: int, index: int) -> dict[str, Any]:
        """Returns one draw, as overrides of the scenario.

        It depends on the seed and the index alone: every method of a pair sees the same
        one, independent of other trials.

        Args:
            scenario: The scenario around which to draw.
            seed: The study's seed.
            index: Which draw of the study.
        """


@dataclass(frozen=True)
class Variation:
    """Random values for any fields of a scenario, written in YAML.

    The text is what an override would be, with a distribution in place of a value. A
    key with dots reaches into a section or a list::

        vehicle.mass: !Scale [0.8, 1.2]        # times the scenario's own
        initial_state.0: !Add [-0.1, 0.1]      # added to the scenario's own
        observer.alpha: !Uniform [4.6, 6.0]
        volume.threshold: !Normal [0.02, 0.005]    # mean and standard deviation
        vehicle.controller.approach_gain: !Choice [0.2, 0.4, 0.6]

    ``!Scale`` and ``!Add`` are uniform between the two numbers.

    Attributes:
        text: The YAML text; empty for no variation.
        label: A short name for records; by default the text on one line.
    """

    text: str = ""
    label: str = ""

    @property
    def name(self) -> str:
        """The label, or the text on one line."""
        return self.label or (
            one_line(compose(self.text, _SOURCE, "")) if self.text else "none"
        )

    def draw(self, scenario: Scenario, seed: int, index: int) -> dict[str, Any]:
        """Returns one draw; see `Draw`.

        Raises:
            ScenarioError: The text is no variation of this scenario.
        """
        generator = np.random.default_rng([seed, index])
        overrides: dict[str, Any] = _drawn(_parse(self.text), scenario, generator, "")
        return overrides


@dataclass(frozen=True)
class PythonVariation:
    """A variation that is computed: ``draw(scenario, generator)`` of a Python file.

    The function gets the `Scenario` and a seeded ``numpy.random.Generator`` and returns
    overrides as `load_scenario` takes them. A study on a cluster needs the file at the
    same path on every machine.

    Attributes:
        path: The file.
    """

    path: str

    @property
    def name(self) -> str:
        """The file's name with a hash of its content."""
        content = Path(self.path).read_bytes()
        return f"{Path(self.path).name} {hashlib.sha256(content).hexdigest()[:8]}"

    def draw(self, scenario: Scenario, seed: int, index: int) -> dict[str, Any]:
        """Returns one draw; see `Draw`.

        Raises:
            ScenarioError: The file has no function ``draw``.
        """
        generator = np.random.default_rng([seed, index])
        overrides: dict[str, Any] = function_of(Path(self.path), "draw")(
            scenario, generator
        )
        return overrides


def load_variation(text_or_path: str) -> Variation | PythonVariation:
    """Returns a variation from YAML text, a YAML file or a Python file.

    Args:
        text_or_path: The text, or a path that ends with ``.yaml``, ``.yml`` or ``.py``.

    Raises:
        ScenarioError: There is no such file, or the text is no variation.
    """
    path = Path(text_or_path)
    if path.suffix not in (".py", ".yaml", ".yml"):
        _parse(text_or_path)
        return Variation(text_or_path)
    text = read_text(path)
    if path.suffix == ".py":
        function_of(path, "draw")
        return PythonVariation(str(path))
    _parse(text)
    return Variation(text)


@dataclass(frozen=True)
class _Distribution:
    kind: str
    values: tuple[Any, ...]

    def draw(self, generator: Generator, own: Any, place: str) -> Any:
        """Returns a value; `own` is the scenario's at that place."""
        if self.kind == "!Choice":
            return self.values[int(generator.integers(len(self.values)))]
        if self.kind == "!Normal":
            return float(generator.normal(*self.values))
        drawn = float(generator.uniform(*self.values))
        if self.kind == "!Uniform":
            return drawn
        if isinstance(own, bool) or not isinstance(own, int | float):
            rule, found = "needs a number of the scenario", repr(own)
            if is_dataclass(own):
                keys = ", ".join(each.name for each in fields(own))
                found = f"the section of {keys}"
            raise ScenarioError(
                f"variation: {place}: {self.kind} {rule}; it has {found:.200} there"
                + ", so take !Uniform, !Normal or !Choice" * (own is None)
            )
        return own + drawn if self.kind == "!Add" else own * drawn


_DISTRIBUTIONS = ("!Uniform", "!Normal", "!Choice", "!Add", "!Scale")


@lru_cache
def _parse(text: str) -> Any:
    """The mappings of a text, with distributions in them."""
    example = "{observer.alpha: !Uniform [4.6, 6.0]}"
    return _read(changes(text or "{}", _SOURCE, example))


def _read(node: Node) -> Any:
    """A part of the text as plain data, with distributions in it."""
    if node.tag in _DISTRIBUTIONS:
        return _distribution(node)
    tag = {"_tag": node.tag} if node.tag.startswith("!") else {}
    if node.id == "mapping":
        return tag | {key: _read(value) for key, (_, value) in entries_of(node).items()}
    if tag:
        allowed = ", ".join(_DISTRIBUTIONS)
        raise _refusal(node, f"is no distribution; allowed: {allowed}")
    return [*map(_read, node.value)] if node.id == "sequence" else scalar_value(node)


def _distribution(node: Node) -> _Distribution:
    values = node.value if node.id == "sequence" else []
    if node.tag == "!Choice":
        if not values:
            raise _refusal(node, "takes a list of values")
        return _Distribution(node.tag, tuple(map(_read, values)))
    numbers = [each.id == "scalar" and scalar_value(each, float) for each in values]
    if len(numbers) != 2 or not all(map(_is_finite, numbers)):
        raise _refusal(node, "takes a list of two finite numbers")
    first, second = numbers
    if node.tag == "!Normal" and second < 0.0:
        raise _refusal(node, f"has the standard deviation {second:g}, below 0")
    if node.tag != "!Normal" and first > second:
        raise _refusal(node, f"goes from {first:g} down to {second:g}")
    return _Distribution(node.tag, (first, second))


def _refusal(node: Node, problem: str) -> ScenarioError:
    return ScenarioError(f"{place_of(node)}: {node.tag} {problem}")


def _is_finite(value: Any) -> bool:
    return isinstance(value, float) and math.isfinite(value)


def _drawn(node: Any, own: Any, generator: Generator, place: str) -> Any:
    """The overrides of a part of the text, where the scenario has `own`."""
    if isinstance(node, _Distribution):
        return node.draw(generator, own, place)
    if isinstance(node, list):
        return [_drawn(child, None, generator, place) for child in node]
    if not isinstance(node, dict):
        return node
    is_list = isinstance(own, list | tuple)
    entries = own if isinstance(own, dict) else getattr(own, "__dict__", {})
    if is_list:
        entries = {str(i): each for i, each in enumerate(own)}
    drawn = {}
    for name, child in node.items():
        key, at = str(name), f"{place}.{name}".strip(".")
        if is_list and key not in entries:
            raise ScenarioError(f"variation: {at}: entries are 0 to {len(own) - 1}")
        drawn[key] = _drawn(child, entries.get(key), generator, at)
    # Numbers as a whole list, which a file need not give; of sections those drawn.
    of_numbers = is_list and not any(map(is_dataclass, own))
    return [*(entries | drawn).values()] if of_numbers else drawn
