"""Mutation testing: does any test notice a fault?

`python -m tests.mutation vcbf_drake/safety --tests tests/test_polytope.py ..` runs the
tests once under coverage, and then of every mutant the tests that reach its line, the
fastest first, each mutant in a process of its own. What no test notices is printed and
kept in out/mutation/results.jsonl; a run that was stopped goes on where it was.
"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from collections.abc import Callable
import gc
import importlib
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import spec_from_file_location
from itertools import accumulate, takewhile
import json
import os
from pathlib import Path
import random
import resource
import signal
import sys
from types import CodeType
from typing import Any

import coverage
import hypothesis
import pytest

from tests.mutation.mutants import Mutant, mutants

# Slow to import, and not of the package: every process inherits them.
_WARM = (
    "hypothesis",
    "matplotlib",
    "mpmath",
    "pydrake.all",
    "quadprog",
    "scipy.optimize",
    "scipy.spatial",
)
# Of the package, from the ground up: what a module imports is not imported before it.
_OWN = ("errors", "plants", "control", "disturbances", "barriers", "safety")
# A test may take this many times its CPU time [s], and a little more, then it hangs.
_PATIENCE = 5.0
# Hypothesis is imported before pytest can rewrite it.
_QUIET = (
    *("-q", "--assert=plain", "-p", "no:cacheprovider"),
    *("-W", "ignore::pytest.PytestAssertRewriteWarning"),
)
_MEASURING = ("-m", "not slow", "--cov", "--cov-context=test", "--cov-report=")
# A test failed, or a module could not be imported.
_NOTICED = (
    pytest.ExitCode.TESTS_FAILED,
    pytest.ExitCode.INTERRUPTED,
    pytest.ExitCode.USAGE_ERROR,
)


class _Stopwatch:
    """A pytest plugin: how long each test took, and an end to tests that hang."""

    def __init__(self, usual: dict[str, float] | None = None) -> None:
        self.seconds: dict[str, float] = {}
        self.failed: list[str] = []
        self._usual = usual

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> object:
        started = _cpu_seconds()
        if self._usual is not None:
            limit = 1.0 + _PATIENCE * self._usual[item.nodeid]
            signal.setitimer(signal.ITIMER_PROF, limit)  # SIGPROF ends the process.
        outcome = yield
        self.seconds[item.nodeid] = _cpu_seconds() - started
        return outcome

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Without a mutant a test that fails says nothing of any."""
        if report.failed:
            self.failed.append(report.nodeid)


def _cpu_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


class _Swap(MetaPathFinder, SourceFileLoader):
    """Imports one module from other code."""

    def __init__(self, name: str, path: str, code: CodeType) -> None:
        SourceFileLoader.__init__(self, name, path)
        self._code = code

    def find_spec(self, name: str, *_: object) -> ModuleSpec | None:
        if name != self.name:
            return None
        return spec_from_file_location(name, self.path, loader=self)

    def get_code(self, name: str) -> CodeType:
        return self._code


def _in_child(work: Callable[[], int]) -> int:
    """The exit status of some work in a process of its own, silent."""
    child = os.fork()
    if child == 0:
        status = 70
        try:
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, 1), os.dup2(null, 2)
            status = int(work())
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _measure(tests: list[str], folder: Path) -> None:
    """Which tests reach which lines, and how long they take: baseline.json."""
    data, seconds = folder / "coverage", folder / "seconds.json"

    def run() -> int:
        os.environ["COVERAGE_FILE"] = str(data)
        watch = _Stopwatch()
        status = pytest.main([*_QUIET, *_MEASURING, *tests], plugins=[watch])
        seconds.write_text(json.dumps({"all": watch.seconds, "failed": watch.failed}))
        return int(status)

    if _in_child(run) > pytest.ExitCode.TESTS_FAILED:
        raise SystemExit("the tests cannot be run")
    measured = json.loads(seconds.read_text())
    for test in measured["failed"]:
        print(f"left out, for it fails without a mutant: {test}")
        del measured["all"][test]
    found = coverage.CoverageData(str(data))
    found.read()
    lines = {
        os.path.relpath(path): {
            line: sorted({c.rsplit("|", 1)[0] for c in contexts} & {*measured["all"]})
            for line, contexts in found.contexts_by_lineno(path).items()
        }
        for path in found.measured_files()
    }
    order = sorted(measured["all"], key=lambda test: (measured["all"][test], test))
    if _in_child(lambda: int(pytest.main([*_QUIET, *order]))) != 0:
        raise SystemExit("without a mutant the tests fail in another order")
    text = json.dumps({"seconds": measured["all"], "lines": lines})
    (folder / "baseline.json").write_text(text)


def _tried(
    path: Path, mutant: Mutant, tests: list[str], usual: dict[str, float], folder: Path
) -> str:
    """How a mutant fares: it survived, a test failed or a test hangs."""
    module = ".".join(path.with_suffix("").parts).removesuffix(".__init__")

    def run() -> int:
        sys.meta_path.insert(0, _Swap(module, str(path), mutant.code))
        watch = _Stopwatch(usual)
        return int(pytest.main([*_QUIET, "-x", *tests], plugins=[watch]))

    status = _in_child(run)
    if status == -signal.SIGPROF:
        return "hangs"
    if status > 0 and status not in _NOTICED:
        raise RuntimeError(f"pytest ended with {status}: {path}, {mutant}")
    return "survived" if status == 0 else "killed"


def _reaching(
    path: Path, line: int, lines: dict[str, list[str]], seconds: dict[str, float]
) -> list[str]:
    """The tests that reach a line, the fastest first.

    A line that runs when its module is imported is reached by every test; then those
    of tests/test_<module>.py come first.
    """
    own = f"tests/test_{path.stem}.py"
    reaching = lines.get(str(line), [])
    if reaching:
        return sorted(reaching, key=lambda test: (seconds[test], test))
    return sorted(
        seconds, key=lambda test: (not test.startswith(own), seconds[test], test)
    )


def _within(budget: float, tests: list[str], seconds: dict[str, float]) -> list[str]:
    """The first tests that fit a budget, one at least."""
    total = list(accumulate(seconds[test] for test in tests))
    return tests[: max(1, sum(spent <= budget for spent in total))]


def _sampled(path: Path, share: float, seed: int) -> list[tuple[int, Mutant]]:
    """A share of a module's mutants, at random, numbered; a larger one adds to it."""
    every = list(enumerate(mutants(path.read_text(), str(path))))
    random.Random(f"{seed} {path}").shuffle(every)
    return every[: round(share * len(every))]


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutation")
    parser.add_argument("package", type=Path, help="a folder of modules, or one module")
    parser.add_argument("--tests", nargs="+", default=["tests"])
    parser.add_argument("--share", type=float, default=1.0, help="of all mutants")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--budget", type=float, default=10.0, help="[s] of tests each")
    parser.add_argument("--out", type=Path, default=Path("out/mutation"))
    options = parser.parse_args()
    below = takewhile(lambda name: name not in options.package.parts, _OWN)
    for name in (*_WARM, *(f"vcbf_drake.{name}" for name in below)):
        importlib.import_module(name)
    gc.freeze()
    hypothesis.settings.register_profile("mutation", database=None, derandomize=True)
    hypothesis.settings.load_profile("mutation")
    options.out.mkdir(parents=True, exist_ok=True)
    baseline = options.out / "baseline.json"
    if not baseline.exists():
        _measure(options.tests, options.out)
    measured = json.loads(baseline.read_text())
    seconds = measured["seconds"]
    paths = sorted(options.package.glob("*.py")) or [options.package]
    with (options.out / "results.jsonl").open("a+") as results:
        results.seek(0)
        done = [json.loads(line) for line in results]
        known = {(r["path"], r["number"]) for r in done}
        for path in paths:
            for number, mutant in _sampled(path, options.share, options.seed):
                if (str(path), number) in known:
                    continue
                lines = measured["lines"].get(str(path), {})
                tests = _reaching(path, mutant.line, lines, seconds)
                tests = _within(options.budget, tests, seconds)
                outcome = _tried(path, mutant, tests, seconds, options.out)
                result = {"path": str(path), "number": number, "outcome": outcome}
                result |= {"line": mutant.line, "before": mutant.before}
                result |= {"after": mutant.after}
                results.write(json.dumps(result) + "\n")
                results.flush()
                done.append(result)
    _print(done)


def _print(results: list[dict[str, Any]]) -> None:
    """What survived, then the counts of every module."""
    for result in results:
        if result["outcome"] == "survived":
            print("{path}:{line}: {before}  ->  {after}".format(**result))
    print(f"{'module':<40}{'mutants':>9}{'killed':>9}{'hang':>9}{'survived':>9}")
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for result in results:
        for name in (result["path"], "all"):
            counts[name][result["outcome"]] += 1
    for name, count in counts.items():
        figures = (count.total(), count["killed"], count["hangs"], count["survived"])
        print(f"{name:<40}" + "".join(f"{figure:>9}" for figure in figures))
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"{(used.ru_utime + used.ru_stime) / 60.0:.1f} minutes of CPU time")


if __name__ == "__main__":
    main()
