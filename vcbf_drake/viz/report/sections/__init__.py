"""The report's sections, in the order of the paper.

Each module builds one part from its numbers in reproduction.json; figures are drawn
later, from the runs and trials on disk.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from vcbf_drake.viz.report.document import Block, Missing, Section
from vcbf_drake.viz.report.reproduction import Reproduction
from vcbf_drake.viz.report.sections.ablation import ablation
from vcbf_drake.viz.report.sections.car import car_1, car_2
from vcbf_drake.viz.report.sections.explicit import test_2_explicit
from vcbf_drake.viz.report.sections.knobs import knobs
from vcbf_drake.viz.report.sections.population import (
    population_blimp,
    population_car,
)
from vcbf_drake.viz.report.sections.table_1 import table_1
from vcbf_drake.viz.report.sections.test_1 import test_1
from vcbf_drake.viz.report.sections.test_2 import test_2
from vcbf_drake.viz.report.sections.verdicts import verdicts
from vcbf_drake.viz.report.wording import listed

# The key in reproduction.json, the title, and what builds the section's blocks.
_SECTIONS: tuple[tuple[str, str, Callable[[Any, Reproduction], list[Block]]], ...] = (
    ("verdicts", "What was found", verdicts),
    ("test_1", "Test 1: one obstacle in a wind", test_1),
    ("test_2", "Test 2: several obstacles", test_2),
    ("test_2_explicit", "Beside Test 2: an observer that chatters", test_2_explicit),
    ("table_1", "Table I: random starts and gains", table_1),
    ("population_blimp", "Unselected layouts of the blimp", population_blimp),
    ("car_1", "Car experiment 1: avoidance", car_1),
    ("car_2", "Car experiment 2: slow references", car_2),
    ("population_car", "Unselected layouts of the car", population_car),
    ("ablation", "What each correction buys", ablation),
    ("knobs", "The method against its own knobs", knobs),
)


def build_sections(saved: Reproduction) -> list[Section]:
    """Returns the sections that have numbers, and one that names those without."""
    present = [
        Section(key.replace("_", "-"), title, build(saved.data[key], saved))
        for key, title, build in _SECTIONS
        if saved.data.get(key)
    ]
    absent = [f"*{title}*" for key, title, _ in _SECTIONS if not saved.data.get(key)]
    if not absent:
        return present
    words = f"`reproduction.json` has no numbers for {listed(absent)}."
    return [*present, Section("left-out", "Left out", [Missing(words)])]
