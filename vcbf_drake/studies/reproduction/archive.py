"""Archive: where a reproduction keeps its runs and records."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
import json
import math
from pathlib import Path
from typing import Any

from vcbf_drake.simulation.loading import dump_scenario
from vcbf_drake.simulation.result import Result, load_result
from vcbf_drake.simulation.run import simulate
from vcbf_drake.studies.monte_carlo import run_study
from vcbf_drake.studies.trial import Record, Trial
from vcbf_drake.studies.worker_processes import new_pool

# A summary's entries that differ from one computer to the next.
_TIMINGS = ("step_cpu_ms", "real_time_factor")


class Archive:
    """A directory with whole runs below ``runs/`` and records below ``studies/``.

    What is there is not run again.

    Attributes:
        directory: The directory.
    """

    def __init__(self, directory: str | Path, workers: int = 1) -> None:
        """Initialises the archive.

        Args:
            directory: It is made when it is needed.
            workers: How many processes run what is missing.
        """
        self.directory = Path(directory)
        self._workers = workers

    def run_all(
        self, runs: Mapping[str, Trial], progress: Callable[[float], None]
    ) -> None:
        """Runs what is missing, each into the directory of its key.

        Args:
            runs: What to run, by its place below ``runs/``.
            progress: Called with the fraction that is done.
        """
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
        """Returns the records of trials, after running those that are missing.

        Args:
            name: Of the file.
            trials: The trials.
            progress: Called with the fraction that is done.
        """
        path = self.directory / "studies" / f"{name}.jsonl"
        return run_study(trials, path, workers=self._workers, progress=progress)

    def result(self, key: str) -> Result:
        """Returns a run, whole."""
        return load_result(self.directory / "runs" / key)

    def summary(self, key: str) -> Record:
        """Returns a run's summary without its timings."""
        text = (self.directory / "runs" / key / "summary.json").read_text()
        summary = json.loads(text)
        return {
            name: _plain(value)
            for name, value in summary.items()
            if name not in _TIMINGS
        }


def _run_each(missing: Mapping[Path, Trial], workers: int) -> Iterator[None]:
    if workers == 1:
        for directory, trial in missing.items():
            _run_and_save(directory, trial)
            yield
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


def _plain(value: Any) -> Any:
    """The value with None for what JSON has no number for."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    finite = not isinstance(value, float) or math.isfinite(value)
    return value if finite else None
