"""Functions of a user's Python file, and the line of it that fails."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from functools import cache
import hashlib
import importlib.util
from pathlib import Path
import sys
from typing import Any

from vcbf_drake.checks import require
from vcbf_drake.errors import ScenarioError, VcbfError, place_of
from vcbf_drake.typed import classes_in_use


def function_of(path: Path, name: str) -> Any:
    """Returns a function of a Python file, which is run once a process.

    Raises:
        ScenarioError: The file cannot be run, or has no such function.
    """
    with naming_place(path):
        names = vars(_module_of(path.resolve()))
        classes_in_use[:] = filter(is_dataclass, names.values())
        function = names.get(name)
        require(callable(function), f"{name}()", function, "a function of this file")
    return function


@cache
def _module_of(path: Path) -> Any:
    # Registered under a name of its own: pickle and type hints find its classes by it.
    digest = hashlib.sha256(str(path).encode()).hexdigest()[:8]
    name = f"vcbf_scenario_{path.stem}_{digest}"
    spec: Any = importlib.util.spec_from_file_location(name, path)
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@contextmanager
def naming_place(path: Path) -> Iterator[None]:
    """Names the line of a user's file whose code fails.

    Raises:
        ScenarioError: It failed.
    """
    try:
        yield
    except Exception as error:  # The file's own code may raise anything.
        kind = "" if isinstance(error, VcbfError) else f"{type(error).__name__}: "
        raise ScenarioError(f"{place_of(error) or path}: {kind}{error}") from error
