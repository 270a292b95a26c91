"""run_study: many trials, one line of a file each, resumed after interruptions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future
from itertools import islice
import json
from pathlib import Path
from queue import SimpleQueue

from vcbf_drake.errors import ScenarioError
from vcbf_drake.files import atomic_write, json_text
from vcbf_drake.studies.executors import TRIALS_A_PROCESS, WorkerProcesses
from vcbf_drake.studies.trial import Record, Trial, error_record, run_trial

# More would only wait in the executor's memory.
_MOST_SUBMITTED = 10_000


def run_study(
    trials: Sequence[Trial],
    path: str | Path,
    executor: Executor | None = None,
    workers: int = 1,
    progress: Callable[[float], None] | None = None,
) -> list[Record]:
    """Runs the trials that a file has no record of, and returns the records of all.

    Each record is a line of JSON, written when its trial ends. A study that was killed
    goes on where it was; a last line that was cut short is dropped. The finished file
    lists the records in the order of the trials, independent of their execution.

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
            known = _key(record) in wanted
        except (ValueError, KeyError, TypeError):
            raise ScenarioError(f"{path}:{number}: not the record of a trial") from None
        if not known:
            raise ScenarioError(
                f"{path}:{number}: the record of another study (index"
                f" {record['index']}, {record['method']}, seed {record['seed']},"
                f" {record['variation']}, {record['scenario']}"
                f" {record['overrides']}); use another file"
            )
        yield record


def _write(path: Path, records: Iterable[Record]) -> None:
    atomic_write(path, "".join(map(_line, records)))


def _line(record: Record) -> str:
    return json_text(record, indent=None)
