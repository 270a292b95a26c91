"""The archive of a reproduction: its runs, records and numbers, resumable."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
import dataclasses
import hashlib
from importlib.metadata import version
import json
from pathlib import Path
from typing import Any

import vcbf_drake
from vcbf_drake.errors import ScenarioError
from vcbf_drake.files import atomic_write
from vcbf_drake.simulation.loading import dump_scenario
from vcbf_drake.simulation.result import Result, load_result
from vcbf_drake.simulation.run import simulate
from vcbf_drake.studies import Record, Trial, run_study
from vcbf_drake.studies.executors import new_pool
from vcbf_drake.viz.runs import Run, label_runs
from vcbf_drake.viz.style import METHOD_STYLES

from .experiment import Experiment, Numbers, Settings, verdicts

RESULTS = "reproduction.json"
Progress = Callable[[str, float], None]

# A summary's entries that differ from one computer to the next.
_TIMINGS = ("step_cpu_ms", "real_time_factor")
# Rooms of the package that no simulation runs.
_NOT_SIMULATED = ("cli", "hil", "viz")


def in_drawing_order(by_method: Mapping[str, Any]) -> dict[str, Any]:
    """Entries by method, the method to bring out last."""
    return {name: by_method[name] for name in METHOD_STYLES if name in by_method}


class Archive:
    """A directory with whole runs below ``runs/`` and records below ``studies/``.

    What is there is not run again.

    Args:
        directory: It is made when it is needed.
        workers: How many processes run what is missing.
    """

    def __init__(self, directory: str | Path, workers: int = 1) -> None:
        self.directory = Path(directory)
        self._workers = workers
        self._results: dict[str, Result] = {}

    def run_all(
        self, runs: Mapping[str, Trial], progress: Callable[[float], None]
    ) -> None:
        """Runs what is missing, each into the directory of its key."""
        missing = {
            self.directory / "runs" / key: trial
            for key, trial in runs.items()
            if not _is_saved(self.directory / "runs" / key, trial)
        }
        progress(1.0 - len(missing) / len(runs))
        for number, _ in enumerate(_run_each(missing, self._workers), start=1):
            progress(1.0 - (len(missing) - number) / len(runs))

    def study(
        self, name: str, trials: Sequence[Trial], progress: Callable[[float], None]
    ) -> list[Record]:
        """Returns the records of trials, after running those that are missing."""
        path = self.directory / "studies" / f"{name}.jsonl"
        return run_study(trials, path, workers=self._workers, progress=progress)

    def result(self, key: str) -> Result:
        """Returns a run, whole.

        Raises:
            FileNotFoundError: It is missing.
        """
        if key not in self._results:
            self._results[key] = load_result(self.directory / "runs" / key)
        return self._results[key]

    def summary(self, key: str) -> Record:
        """Returns a run's summary without its timings."""
        text = (self.directory / "runs" / key / "summary.json").read_text()
        # NaN and infinities are no JSON.
        summary = json.loads(text, parse_constant=lambda _: None)
        return {name: each for name, each in summary.items() if name not in _TIMINGS}

    def records(self, path: str) -> list[Record]:
        """Returns the records of a study's trials."""
        lines = (self.directory / path).read_text(encoding="utf-8").splitlines()
        return [json.loads(line) for line in lines]

    def results(self, runs: Mapping[str, Numbers]) -> list[Result]:
        """Returns some runs of the numbers, whole, the one to bring out last."""
        return [
            self.result(str(entry["run"]).removeprefix("runs/"))
            for entry in in_drawing_order(runs).values()
        ]

    def labelled(self, runs: Mapping[str, Numbers]) -> list[Run]:
        """Returns the same, ready to be drawn."""
        return label_runs(self.results(runs))


def reproduce(
    directory: str | Path,
    experiments: Sequence[Experiment],
    settings: Settings,
    workers: int = 1,
    progress: Progress = lambda name, done: None,
) -> dict[str, Any]:
    """Runs what is missing of some experiments and writes ``reproduction.json``.

    The file holds every number; it is the same, bit for bit, however often the work was
    interrupted and whatever the number of workers.

    Args:
        directory: Where runs, records and numbers are kept.
        experiments: What is wanted.
        settings: How much is run.
        workers: How many processes.
        progress: Called with the key of the experiment at work and the fraction of all
            that is done.

    Returns:
        What the file holds.

    Raises:
        ScenarioError: The directory holds a reproduction with other settings.
    """
    directory = Path(directory)
    data: dict[str, Any] = {"settings": _claim(directory, settings)}
    archive = Archive(directory, workers)
    plans = {each.key: each.plan(settings) for each in experiments}
    total, done = sum(plan.cost for plan in plans.values()), 0

    def part(key: str, cost: int) -> Callable[[float], None]:
        """Turns the progress of a part into that of all."""
        nonlocal done
        start, done = done, done + cost
        return lambda fraction: progress(key, (start + fraction * cost) / total)

    for key, plan in plans.items():
        if plan.runs:
            archive.run_all(plan.runs, part(key, len(plan.runs)))
        records = {
            name: archive.study(name, trials, part(key, len(trials)))
            for name, trials in plan.studies.items()
        }
        quick = " --quick" if settings.quick else ""
        command = f"python -m examples.paper{quick} --only {key}"
        data[key] = {"command": command, **plan.evaluate(archive, records)}
    data["verdicts"] = verdicts(experiments, data)
    _write(directory / RESULTS, data)
    return data


def _run_each(missing: Mapping[Path, Trial], workers: int) -> Iterator[None]:
    if workers == 1:
        for directory, trial in missing.items():
            yield _run_and_save(directory, trial)
        return
    with new_pool(workers) as pool:
        futures = [pool.submit(_run_and_save, *each) for each in missing.items()]
        for future in as_completed(futures):
            yield future.result()


def _run_and_save(directory: Path, trial: Trial) -> None:
    # The summary is written last: a run is whole when it is there.
    (directory / "summary.json").unlink(missing_ok=True)
    simulate(trial.load()).save(directory)


def _is_saved(directory: Path, trial: Trial) -> bool:
    if not (directory / "summary.json").exists():
        return False
    return (directory / "scenario.yaml").read_text() == dump_scenario(trial.load())


def _claim(directory: Path, settings: Settings) -> dict[str, Any]:
    """Returns the settings, after checking that the directory is for none but them."""
    claimed = dataclasses.asdict(settings) | {
        "versions": {name: version(name) for name in ("drake", "numpy")},
        "code": code_fingerprint(),
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


def code_fingerprint() -> str:
    """Returns a hash of the code that simulates: two versions' runs must not mix."""
    package, digest = Path(vcbf_drake.__file__).parent, hashlib.sha256()
    for path in sorted(package.rglob("*")):
        inside = path.relative_to(package)
        if path.suffix in (".py", ".yaml") and inside.parts[0] not in _NOT_SIMULATED:
            digest.update(inside.as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def _write(path: Path, data: Mapping[str, Any]) -> None:
    text = json.dumps(data, indent=2, allow_nan=False, ensure_ascii=False)
    atomic_write(path, text + "\n")
