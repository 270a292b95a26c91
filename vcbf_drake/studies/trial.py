"""The trials of a study: their records, each a line of a file, also after a break."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future
from dataclasses import dataclass, field
from functools import cache
import hashlib
from itertools import chain, islice
import json
import math
from pathlib import Path
from queue import SimpleQueue
import shlex
from typing import Any

from vcbf_drake.errors import ScenarioError
from vcbf_drake.files import atomic_write, json_text
from vcbf_drake.simulation.fleet import Fleet
from vcbf_drake.simulation.loading import load_fleet, merge_overrides, scenario_path
from vcbf_drake.simulation.run import simulate_fleet
from vcbf_drake.simulation.scenario import Scenario
from vcbf_drake.studies.executors import TRIALS_A_PROCESS, WorkerProcesses, versions
from vcbf_drake.studies.variation import Draw, Variation

Record = dict[str, Any]

# More would only wait in an executor's memory.
_MOST_SUBMITTED = 10_000

# The numbers of a summary that are kept, and which of several vehicles' is worst.
_NUMBERS: dict[str, Callable[..., Any]] = {
    "running_time": min,
    "reached_at": max,
    "infeasible_at": min,
    "collided_at": min,
    "min_barrier": min,
    "min_volume": min,
    "max_abs_slack": max,
    "ticks": max,
    "relaxed_ticks": max,
    "infeasible_ticks": max,
    "decayed_ticks": max,
    "failed_ticks": max,
    "final_status": max,
}
# The best first.
_OUTCOMES = ("reached", "timeout", "infeasible", "failed", "collision")


@dataclass(frozen=True)
class Trial:
    """One run of a study; it pickles, so that any process can run it.

    Attributes:
        scenario: A shipped scenario's name, or the path of a YAML file.
        method: The safety filter.
        index: Which draw of the variation; a pair of trials shares it.
        seed: The study's seed.
        variation: The variation that is drawn.
        overrides: YAML text with values that replace the scenario's; empty for none.
        scenario_name: Which scenario of a file that holds several; else empty.
    """

    scenario: str
    method: str
    index: int
    seed: int = 0
    variation: Draw = field(default_factory=Variation)
    overrides: str = ""
    scenario_name: str = ""

    @property
    def identity(self) -> Record:
        """The identity of the trial among all others; part of its record."""
        return {
            "scenario": " ".join([self.scenario, self.scenario_name]).strip(),
            "overrides": self.overrides,
            "variation": self.variation.name,
            "seed": self.seed,
            "index": self.index,
            "method": self.method,
            "made_with": _made_with(self.scenario),
        }

    def all_overrides(self) -> str:
        """Returns the overrides with the draw, as YAML text.

        Raises:
            ScenarioError: The scenario does not load.
        """
        given = self.overrides or "{}"
        base: Any = load_fleet(self.scenario, given, self.scenario_name or None)
        if len(base.vehicles) == 1:
            (base,) = base.vehicles
        return merge_overrides(given, self.variation.draw(base, self.seed, self.index))

    def load(self) -> Scenario:
        """Returns the scenario of this trial's only vehicle.

        Raises:
            ScenarioError: It does not load, or has several.
        """
        return self.load_fleet().only(self.scenario)

    def load_fleet(self) -> Fleet:
        """Returns the vehicles of this trial.

        Raises:
            ScenarioError: They do not load.
        """
        overrides, name = self.all_overrides(), self.scenario_name or None
        try:
            fleet = load_fleet(self.scenario, overrides, name)
        except ScenarioError as error:  # Without what was drawn, it loads.
            problem = str(error).removeprefix("override: ")
            raise ScenarioError(f"variation: {problem}") from None
        fleet.set_method(self.method)
        return fleet

    def command(self) -> str:
        """Returns the command line that runs this trial again, with its pictures."""
        words = ["vcbf-drake", "run", self.scenario, "--method", self.method]
        words += ["--override", self.all_overrides()]
        if self.scenario_name:
            words += ["--scenario-name", self.scenario_name]
        return shlex.join(words)


_versions = cache(versions)


def _made_with(scenario: str) -> str:
    """The versions that a record rests on, and its scenario's file by a hash."""
    try:
        content = scenario_path(scenario).read_bytes()
    except (ScenarioError, OSError):  # A trial's own record tells.
        content = b""
    digest = hashlib.sha256(content).hexdigest()[:8]
    return f"{_versions()}, scenario {digest}"


def run_trial(trial: Trial) -> Record:
    """Runs a trial; a crash is part of the record.

    Returns:
        The trial's identity; the outcome and the numbers of the run's summary, the
        running time being the lesser of the duration and the first infeasible tick
        (R47); why it is not guaranteed; the error, or None. Of several vehicles what
        is worst of each.
    """
    try:
        fleet = trial.load_fleet()
        summaries = [each.summary for each in simulate_fleet(fleet, step_time=False)]
    except Exception as error:
        return error_record(trial, f"{type(error).__name__}: {error}")
    numbers = {
        name: _worst_of(worse, [each[name] for each in summaries])
        for name, worse in _NUMBERS.items()
    }
    # Only where a backup manoeuvre is kept there is something to guarantee.
    kept = [each.get("guaranteed_feasible") for each in summaries]
    numbers["guaranteed_feasible"] = None if None in kept else all(kept)
    numbers["running_time"] = min(fleet.duration, numbers["running_time"] or 0.0)
    if None in [each["reached_at"] for each in summaries]:
        numbers["reached_at"] = None
    reasons = chain.from_iterable(each["reasons_against"] for each in summaries)
    return {
        **trial.identity,
        "outcome": max((each["outcome"] for each in summaries), key=_OUTCOMES.index),
        **numbers,
        "reasons_against": list(dict.fromkeys(reasons)),
        "error": None,
    }


def _worst_of(worse: Callable[..., Any], values: Sequence[float | None]) -> Any:
    """The worst value that JSON has; None without one."""
    kept = (each for each in values if each is not None and math.isfinite(each))
    return worse(kept, default=None)


def error_record(trial: Trial, error: str) -> Record:
    """Returns the record of a trial that did not end, with the reason."""
    return {
        **trial.identity,
        "outcome": "error",
        **dict.fromkeys((*_NUMBERS, "guaranteed_feasible", "reasons_against")),
        "error": error,
    }


def run_study(
    trials: Sequence[Trial],
    path: str | Path,
    executor: Executor | None = None,
    workers: int = 1,
    progress: Callable[[float], None] | None = None,
) -> list[Record]:
    """Runs the trials that a file has no record of, and returns the records of all.

    Each record is a line of JSON, written when its trial ends. A study that was killed
    goes on where it was, with the same versions and the same scenario file; a last line
    that was cut short is dropped. The finished file lists the records in the order of
    the trials, independent of their execution.

    Args:
        trials: The trials, each different from the others.
        path: The file; it is made if it is missing.
        executor: The executor of the trials, for example Dask's; it stays open. By
            default `workers` processes; a few trials for one worker run in this one.
        workers: The number of processes, without an executor. The calling script needs
            an ``if __name__ == "__main__"`` guard for them.
        progress: Called after each trial with the fraction that is done.

    Raises:
        ScenarioError: The file holds something else than records of these trials.
        BrokenExecutor: The executor given broke; what is done is in the file.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    wanted = {_key(trial.identity): trial for trial in trials}
    records = {_key(record): record for record in _read(path, wanted)}
    _write(path, records.values())
    missing = [trial for key, trial in wanted.items() if key not in records]
    with path.open("a", encoding="utf-8", newline="\n") as file:
        for record in _run(missing, executor, workers):
            file.write(_line(record))
            file.flush()
            records[_key(record)] = record
            if progress is not None:
                progress(len(records) / len(wanted))
    ordered = [records[key] for key in wanted]
    _write(path, ordered)
    return ordered


def _run(
    trials: Sequence[Trial], executor: Executor | None, workers: int
) -> Iterator[Record]:
    if executor is not None:
        yield from _run_with(executor, trials, _MOST_SUBMITTED)
    elif workers == 1 and len(trials) <= TRIALS_A_PROCESS:
        yield from map(run_trial, trials)
    else:
        # A broken pool loses its waiting trials: there are no more than processes.
        with WorkerProcesses(workers) as processes:
            yield from _run_with(processes, trials, workers)


def _run_with(
    executor: Executor, trials: Iterable[Trial], most: int
) -> Iterator[Record]:
    """Yields the records of trials as they end, also if workers die.

    A trial's own errors are in its record, so a failure is the executor's: its worker
    died, with this trial or with one beside it. Those trials are run again, each alone;
    the one that fails again is recorded so.
    """
    lost = []
    for trial, future in _submit(executor, trials, most):
        if future.exception() is None:
            yield future.result()
        else:
            lost.append(trial)
    # An executor that broke for good raises here.
    for trial, future in _submit(executor, lost, 1):
        error = future.exception()
        if error is None:
            yield future.result()
        elif isinstance(error, BrokenExecutor):
            yield error_record(trial, "its process died, twice")
        else:
            yield error_record(trial, f"{type(error).__name__}: {error}")


def _submit(
    executor: Executor, trials: Iterable[Trial], most: int
) -> Iterator[tuple[Trial, Future[Record]]]:
    """Yields trials with their futures as these end, `most` of them under way."""
    waiting, running = iter(trials), dict[Future[Record], Trial]()
    ended: SimpleQueue[Future[Record]] = SimpleQueue()
    try:
        while True:
            for trial in islice(waiting, most - len(running)):
                future = executor.submit(run_trial, trial)
                running[future] = trial
                future.add_done_callback(ended.put)
            if not running:
                return
            future = ended.get()
            yield running.pop(future), future
    finally:
        for future in running:
            future.cancel()


def _key(identity: Record) -> str:
    names = ("scenario", "overrides", "variation", "seed", "index", "method")
    return json.dumps([identity[name] for name in names])


def _read(path: Path, wanted: dict[str, Trial]) -> Iterator[Record]:
    """Yields the records of the file's whole lines."""
    content = path.read_bytes() if path.exists() else b""
    # Text after the last line break was cut short, even if it is valid JSON.
    for number, line in enumerate(content.split(b"\n")[:-1], start=1):
        try:
            record = json.loads(line)
            trial = wanted.get(_key(record))
        except (ValueError, KeyError, TypeError):
            raise ScenarioError(f"{path}:{number}: not the record of a trial") from None
        if trial is None:
            raise ScenarioError(
                f"{path}:{number}: the record of another study (index"
                f" {record['index']}, {record['method']}, seed {record['seed']},"
                f" {record['variation']}, {record['scenario']}"
                f" {record['overrides']}); use another file"
            )
        found = record.get("made_with", "versions that it does not name")
        now = trial.identity["made_with"]
        if found != now:
            raise ScenarioError(
                f"{path}:{number}: made with {found}; here it is {now}; use another"
                " file"
            )
        yield record


def _write(path: Path, records: Iterable[Record]) -> None:
    atomic_write(path, "".join(map(_line, records)))


def _line(record: Record) -> str:
    return json_text(record, indent=None)
