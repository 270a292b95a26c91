"""Scenarios from Python files, returned by their function ``scenario()``."""

from __future__ import annotations

from functools import cache
import importlib.util
from pathlib import Path
import sys
import traceback
from types import ModuleType

from vcbf_drake.errors import InvalidValueError, ScenarioError
from vcbf_drake.simulation.fleet import Fleet
from vcbf_drake.simulation.scenario import Scenario


def scenario_of(path: Path) -> Scenario | Fleet:
    """Returns the scenario of a Python file, made anew.

    Args:
        path: The file; it is run, once a process.

    Raises:
        ScenarioError: One line that says where the file fails, or what it lacks.
    """
    try:
        make = getattr(module_of(path.resolve()), "scenario", None)
        made = make() if callable(make) else None
    except InvalidValueError as error:
        raise ScenarioError(f"{_place(path, error)}: {error}") from error
    except Exception as error:  # The file's own code may raise anything.
        kind = type(error).__name__
        raise ScenarioError(f"{_place(path, error)}: {kind}: {error}") from error
    if not isinstance(made, Scenario | Fleet):
        found = "no function scenario()" if make is None else f"a {type(made).__name__}"
        raise ScenarioError(
            f"{path}: {found}; it must have a function scenario() that returns a"
            " vcbf_drake.Scenario or Fleet"
        )
    made.name = made.name or path.stem
    return made


@cache
def module_of(path: Path) -> ModuleType:
    """Returns the module of a file; its dataclasses' types are found by its name.

    Args:
        path: The file; it is run, once a process.
    """
    spec = importlib.util.spec_from_file_location(f"vcbf_scenario_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ImportError("it is no Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[module.__name__]
        raise
    return module


def _place(path: Path, error: Exception) -> str:
    """Returns the file with its last line in the error's traceback."""
    if isinstance(error, SyntaxError):
        return f"{path}:{error.lineno}"
    frames = traceback.extract_tb(error.__traceback__)
    lines = [f.lineno for f in frames if Path(f.filename) == path.resolve()]
    return f"{path}:{lines[-1]}" if lines else str(path)
