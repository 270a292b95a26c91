"""The errors this package raises; each carries the data that failed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path as FilePath
import site
import sysconfig
import traceback
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from vcbf_drake.checks import Array

# A set that is empty by less than this may be flat [units of u].
_ROUNDING = 1e-9
# Fields and list indices that lead to one value, outermost first.
Path: TypeAlias = tuple[str | int, ...]


class VcbfError(Exception):
    """Base of every error this package raises on purpose."""


class EmptySetError(VcbfError):
    """No point satisfies ``A u <= b``, or none but those of a flat set.

    Attributes:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
        inradius: The signed Chebyshev radius (in units of u), or that of the rows in
            conflict alone, which is no less; negative, but for a set that is flat
            where an interior is asked for.
        multipliers: Farkas' proof: y >= 0 with y'A = 0 and y'b < 0, shape (n,); zeros
            where it is not known.
        conflict: Indices of the rows with y > 0, which exclude each other.
    """

    def __init__(
        self, A: Array, b: Array, inradius: float, multipliers: Array | None = None
    ) -> None:
        # Where rounding leaves it open whether there is a point, at least no ball is.
        what = "is empty" if inradius < -_ROUNDING else "has no interior"
        super().__init__(
            f"the set {{u : A u <= b}} {what}: its signed Chebyshev radius is"
            f" {inradius:.3g}"
        )
        self.A, self.b, self.inradius = A, b, inradius
        self.multipliers = np.zeros(len(b)) if multipliers is None else multipliers
        self.conflict: tuple[int, ...] = tuple(
            np.flatnonzero(self.multipliers).tolist()
        )


class UnboundedSetError(VcbfError):
    """The set ``A u <= b`` contains a ray, so it has no largest ellipsoid.

    Attributes:
        A: The rows, shape (n, m).
        b: The right-hand sides, shape (n,).
        direction: A direction in which the set never ends, shape (m,).
    """

    def __init__(self, A: Array, b: Array, direction: Array) -> None:
        super().__init__(
            "the set {u : A u <= b} is unbounded, for example along"
            f" {np.array2string(direction, precision=3)}"
        )
        self.A, self.b, self.direction = A, b, direction


class SolverError(VcbfError):
    """A solver returned nothing that could be verified.

    Attributes:
        A: The rows of the problem, shape (n, m).
        b: The right-hand sides, shape (n,).
    """

    def __init__(self, message: str, A: Array, b: Array) -> None:
        super().__init__(message)
        self.A, self.b = A, b


class ModelError(VcbfError):
    """A system, barrier or disturbance does not meet what the method needs."""


class InvalidValueError(ModelError, ValueError):
    """A value that a user gave and that is not allowed.

    Attributes:
        path: The path of the value, from the object that was to be made.
        problem: The value, and what is allowed.
    """

    def __init__(self, path: str | Path, problem: str) -> None:
        self.path = (path,) if isinstance(path, str) else path
        self.problem = problem
        super().__init__(": ".join(filter(None, (written(self.path), problem))))


@contextmanager
def below(*path: str | int) -> Iterator[None]:
    """Prefixes the path of an invalid value with that of the part that refuses it.

    Raises:
        InvalidValueError: A part raised it, or a `ValueError`, or a `VcbfError`.
    """
    try:
        yield
    except InvalidValueError as error:
        first, *others = error.path or ("",)
        first = first.rpartition(": ")[2] if isinstance(first, str) else first
        own = (first, *others) if error.path else ()
        raise InvalidValueError((*path, *own), error.problem) from None
    except (ValueError, VcbfError) as error:
        raise InvalidValueError(path, str(error)) from None


def written(path: Path) -> str:
    """Returns a path as one writes it, for example ``obstacles[1].radius``."""
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in path)
    return "".join(parts).removeprefix(".")


class UserCodeError(VcbfError):
    """A user's own code raised while a system was evaluated: which, when and where."""


@contextmanager
def naming_user_code(time: Callable[[], float]) -> Iterator[None]:
    """Adds the system, the time and the line of the user's code to an error.

    Args:
        time: Returns the time of the context that was evaluated [s].

    Raises:
        UserCodeError: From what a line raised that is of no library.
        InvalidValueError: From a value that was refused.
    """
    try:
        yield
    except Exception as error:
        name, place = "", place_of(error)
        for frame, _ in traceback.walk_tb(error.__traceback__):
            system: Any = frame.f_locals.get("self")
            if hasattr(system, "num_input_ports"):
                name = str(system.get_name())
        at = f"{name or 'a system'} at t = {time():g} s"
        if isinstance(error, InvalidValueError):
            raise InvalidValueError(at, str(error)) from error
        if not place:
            raise
        kind = type(error).__name__
        raise UserCodeError(f"{at}, {place}: {kind}: {error}") from error


def place_of(error: BaseException) -> str:
    """Returns file and line of the user's own code that raised; empty for none."""
    if isinstance(error, SyntaxError):
        return f"{error.filename}:{error.lineno}"
    lines = traceback.walk_tb(error.__traceback__)
    places = [(frame.f_code.co_filename, line) for frame, line in lines]
    own = [f"{file}:{line}" for file, line in places if _is_own(file)]
    return own[-1] if own else ""


_LIBRARIES = [
    FilePath(__file__).resolve().parent,
    *map(FilePath, sysconfig.get_paths().values()),
    *map(FilePath, site.getsitepackages()),
]


def _is_own(file: str) -> bool:
    """Whether a file is a user's: of no library, and no code made at run time."""
    path = FilePath(file).resolve()
    return path.is_file() and not any(path.is_relative_to(each) for each in _LIBRARIES)


class ScenarioError(VcbfError):
    """A scenario cannot be loaded: one line with file, key, value, what is allowed.

    The line is printable for any file: other characters are escaped.
    """

    def __init__(self, message: str) -> None:
        super().__init__("".join(map(_printable, message)))


def _printable(character: str) -> str:
    return character if character.isprintable() else ascii(character)[1:-1]
