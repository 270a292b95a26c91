"""reproduce: everything the paper shows, and every number in one file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import dataclasses
import hashlib
from importlib.metadata import version
import json
import os
from pathlib import Path
from typing import Any

import vcbf_drake
from vcbf_drake.errors import ScenarioError
from vcbf_drake.studies.reproduction.ablation import ablation
from vcbf_drake.studies.reproduction.archive import Archive
from vcbf_drake.studies.reproduction.blimp_test_1 import test_1
from vcbf_drake.studies.reproduction.blimp_test_2 import test_2
from vcbf_drake.studies.reproduction.blimp_test_2_explicit import test_2_explicit
from vcbf_drake.studies.reproduction.car_1 import car_1
from vcbf_drake.studies.reproduction.car_2 import car_2
from vcbf_drake.studies.reproduction.knobs import knobs
from vcbf_drake.studies.reproduction.population import population_blimp, population_car
from vcbf_drake.studies.reproduction.section import Section
from vcbf_drake.studies.reproduction.settings import Settings
from vcbf_drake.studies.reproduction.table_1 import table_1
from vcbf_drake.studies.reproduction.verdicts import verdicts

# In the order of the report.
SECTIONS: dict[str, Callable[[Settings], Section]] = {
    "test_1": test_1,
    "test_2": test_2,
    "test_2_explicit": test_2_explicit,
    "table_1": table_1,
    "population_blimp": population_blimp,
    "car_1": car_1,
    "car_2": car_2,
    "population_car": population_car,
    "ablation": ablation,
    "knobs": knobs,
}

RESULTS = "reproduction.json"

# What a simulation runs.
_SIMULATED = (
    "barriers",
    "control",
    "disturbances",
    "plants",
    "safety",
    "simulation",
)

Progress = Callable[[str, float], None]


def reproduce(
    directory: str | Path,
    settings: Settings,
    workers: int = 1,
    progress: Progress | None = None,
    only: Sequence[str] = tuple(SECTIONS),
) -> dict[str, Any]:
    """Runs what of the reproduction is missing and writes ``reproduction.json``.

    The file holds every number; it is the same, bit for bit, however often the work was
    interrupted and whatever the number of workers.

    Args:
        directory: Where runs, records and numbers are kept.
        settings: How much is run.
        workers: How many processes.
        progress: Called with the name of the section at work and the fraction of all
            that is done.
        only: The sections wanted.

    Returns:
        What the file holds.

    Raises:
        ScenarioError: The directory holds a reproduction with other settings.
    """
    directory = Path(directory)
    data: dict[str, Any] = {"settings": _claim(directory, settings)}
    archive = Archive(directory, workers)
    sections = [make(settings) for name, make in SECTIONS.items() if name in only]
    steps = _Steps(sum(section.cost for section in sections), progress)
    for section in sections:
        if section.runs:
            advance = steps.step(section.name, len(section.runs))
            archive.run_all(section.runs, advance)
        records = {}
        for name, trials in section.studies.items():
            advance = steps.step(section.name, len(trials))
            records[name] = archive.study(name, trials, advance)
        data[section.name] = {
            "command": _command(section.name, settings),
            **section.evaluate(archive, records),
        }
    data["verdicts"] = verdicts(data)
    _write(directory / RESULTS, data)
    return data


class _Steps:
    """Turns the progress of each step into that of all."""

    def __init__(self, total: int, progress: Progress | None) -> None:
        self._total, self._done, self._progress = total, 0, progress

    def step(self, name: str, cost: int) -> Callable[[float], None]:
        start = self._done
        self._done += cost

        def advance(fraction: float) -> None:
            if self._progress is not None:
                self._progress(name, (start + fraction * cost) / self._total)

        return advance


def _command(name: str, settings: Settings) -> str:
    quick = " --quick" if settings.quick else ""
    return f"vcbf-drake reproduce{quick} --only {name}"


def _claim(directory: Path, settings: Settings) -> dict[str, Any]:
    """Returns the settings, after checking that the directory is for none but them."""
    claimed = dataclasses.asdict(settings) | {
        "versions": {name: version(name) for name in ("drake", "numpy")},
        "code": _fingerprint(),
    }
    path = directory / "settings.json"
    if path.exists() and json.loads(path.read_text()) != claimed:
        raise ScenarioError(
            f"{directory}: holds a reproduction with other settings, versions or code"
            f" ({path.name}); give another directory"
        )
    directory.mkdir(parents=True, exist_ok=True)
    _write(path, claimed)
    return claimed


def _fingerprint() -> str:
    """A hash of the code that simulates: what two versions ran must not be mixed."""
    package, digest = Path(vcbf_drake.__file__).parent, hashlib.sha256()
    for room in _SIMULATED:
        for path in sorted((package / room).rglob("*")):
            if path.suffix in (".py", ".yaml"):
                digest.update(path.relative_to(package).as_posix().encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _write(path: Path, data: dict[str, Any]) -> None:
    """Writes the whole file, or leaves it as it was."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    text = json.dumps(data, indent=2, allow_nan=False, ensure_ascii=False)
    temporary.write_text(text + "\n", encoding="utf-8")
    os.replace(temporary, path)
