"""Obstacles from files: spheres from a table, polygons from a map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
import csv
from dataclasses import dataclass, field
import io
import json
import logging
import math
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from vcbf_drake.barriers import PolygonObstacle, SphereObstacle
from vcbf_drake.checks import Array
from vcbf_drake.errors import InvalidValueError, below
from vcbf_drake.files import IS_FILE, read_text
from vcbf_drake.typed import Checked, NotNegative, Positive

_LOG = logging.getLogger("vcbf_drake")
_AXES = ("x", "y", "z")
# Where GeoJSON has polygons, by the type of what holds them.
_INNER = {
    "FeatureCollection": "features",
    "GeometryCollection": "geometries",
    "Feature": "geometry",
    "Polygon": "coordinates",
    "MultiPolygon": "coordinates",
}


@dataclass
class SpheresFile(Checked):
    """Spheres, or in the plane discs, from a CSV file: each becomes a `!Sphere`.

    Its first line names the columns: x, y, z for a robot in space, and radius [m];
    where there are some, velocity_x, velocity_y, velocity_z [m/s] and margin [m].

    Attributes:
        file: Path of the file, relative to the scenario's.
        margin: Margin to the surfaces of spheres without one in the file [m].
    """

    TAG: ClassVar[str] = "!Spheres"

    file: str = field(metadata=IS_FILE)
    margin: NotNegative = 0.0

    def obstacles(self) -> list[SphereObstacle]:
        """Returns the spheres.

        Raises:
            InvalidValueError: The file is not as it must be; one line says where.
        """
        needed, velocities = ("x", "y", "radius"), [f"velocity_{a}" for a in _AXES]
        found = []
        for line, row in _table(self.file, needed, ("z", "margin", *velocities)):
            axes = [axis for axis in _AXES if axis in row]
            velocity = [row.get(f"velocity_{axis}", 0.0) for axis in axes]
            try:
                found.append(
                    SphereObstacle(
                        [row[axis] for axis in axes],
                        row["radius"],
                        velocity if any(velocity) else [],
                        row.get("margin", self.margin),
                    )
                )
            except ValueError as error:
                reason = str(error).removeprefix("obstacle: ")
                raise _wrong(self.file, f"line {line}: {reason}") from None
        if not found:
            raise _wrong(self.file, "no sphere")
        return found


@dataclass
class PolygonMap(Checked):
    """Polygons from a map in metres: each becomes one `!Polygon`, or more.

    GeoJSON (``.geojson``, ``.json``): its Polygons and MultiPolygons, by themselves, in
    features or in collections. CSV: a line a corner, with the columns polygon (a
    number), x and y [m]; corners of one number follow each other.

    What has no barrier is covered by more than itself, and the log says so: a hole is
    filled, a polygon whose sides cross is its convex hull.

    Attributes:
        file: Path of the file, relative to the scenario's.
        margin: Margin to the sides [m].
        smoothing: The length over which two sides blend [m].
    """

    TAG: ClassVar[str] = "!PolygonMap"

    file: str = field(metadata=IS_FILE)
    margin: NotNegative = 0.0
    smoothing: Positive = 0.05

    def obstacles(self) -> list[PolygonObstacle]:
        """Returns the polygons.

        Raises:
            InvalidValueError: The file is not as it must be; one line says where.
        """
        if Path(self.file).suffix == ".csv":
            rings = _csv_rings(self.file)
        else:
            try:
                content = json.loads(_text(self.file))
            except (json.JSONDecodeError, RecursionError) as error:
                raise _wrong(self.file, f"not JSON: {error}") from None
            rings = [*_geojson_rings(self.file, content, "")]
        if not rings:
            raise _wrong(self.file, "no polygon")
        return [self._polygon(where, corners) for where, corners in rings]

    def _polygon(self, where: str, corners: Array) -> PolygonObstacle:
        finite = corners.shape == (len(corners), 2) and np.isfinite(corners).all()
        if not finite:
            raise _wrong(self.file, f"{where}: corners of x and y, finite numbers each")
        repeated = np.all(corners == np.roll(corners, -1, axis=0), axis=1)
        corners = corners[~repeated]
        try:
            return PolygonObstacle(corners.tolist(), self.margin, self.smoothing)
        except ValueError as error:
            reason = error
        try:
            around = corners[ConvexHull(corners).vertices].tolist()
        except QhullError:
            raise _wrong(self.file, f"{where}: {reason}") from None
        hull = f"{where} is taken as its convex hull ({reason})"
        _LOG.warning("%s: %s", self.file, hull)
        return PolygonObstacle(around, self.margin, self.smoothing)


def _wrong(file: str, problem: str) -> InvalidValueError:
    return InvalidValueError("file", f"{file}: {problem}")


def _text(file: str) -> str:
    with below("file"):
        text = read_text(Path(file))
    return text


def _table(
    file: str, needed: Sequence[str], optional: Sequence[str] = ()
) -> Iterator[tuple[int, dict[str, float]]]:
    """Yields the rows of a CSV file with the numbers of their lines."""
    lines = io.StringIO(_text(file))
    reader = csv.DictReader(
        lines, restkey="no column", restval="", skipinitialspace=True
    )
    names = [name.strip() for name in reader.fieldnames or ()]
    reader.fieldnames = names
    known = [*needed, *optional]
    fits = set(needed) <= set(names) <= set(known) and len(set(names)) == len(names)
    if not fits:
        may = f"; it may name {', '.join(optional)}" * bool(optional)
        given = ", ".join(names)[:80] or "nothing"
        must = f"it must name {', '.join(needed)}{may}"
        raise _wrong(file, f"line 1: {given}; {must}")
    for texts in reader:
        row = {}
        for name, text in texts.items():
            with suppress(ValueError, TypeError):
                row[name] = float(text)
            if not math.isfinite(row.get(name, math.nan)):
                problem = f"{name}: {str(text)[:40]!r}; it must be a finite number"
                raise _wrong(file, f"line {reader.line_num}: {problem}")
        yield reader.line_num, row


def _csv_rings(file: str) -> list[tuple[str, Array]]:
    rings: dict[float, list[list[float]]] = {}
    for _, row in _table(file, ("polygon", "x", "y")):
        rings.setdefault(row["polygon"], []).append([row["x"], row["y"]])
    return [(f"polygon {key:g}", np.array(each)) for key, each in rings.items()]


def _geojson_rings(file: str, part: Any, at: str) -> Iterator[tuple[str, Array]]:
    """Yields the outer rings of all polygons, with where they are in the file."""
    kind = part.get("type") if isinstance(part, dict) else None
    inner = _INNER.get(str(kind))
    where = at or "the file"
    if inner is None or inner not in part:
        rule = "it must be a Polygon, a MultiPolygon, or what holds such"
        raise _wrong(file, f"{where} is of type {kind!r:.40}; {rule}")
    content, place = part[inner], f"{at}.{inner}".removeprefix(".")
    items = {place: content}
    if kind not in ("Feature", "Polygon"):
        if not isinstance(content, list):
            raise _wrong(file, f"{where}: its {inner} must be a list")
        items = {f"{place}[{i}]": each for i, each in enumerate(content)}
    for place, item in items.items():
        if inner == "coordinates":
            yield place, _outer(file, item, place)
        else:
            yield from _geojson_rings(file, item, place)


def _outer(file: str, rings: Any, where: str) -> Array:
    """Returns the corners of a polygon's outer ring, heights dropped, shape (n, 2)."""
    try:
        outer, *holes = rings
        corners = np.array([point[:2] for point in outer], dtype=float)
    except (TypeError, ValueError, KeyError, IndexError):
        corners, holes = np.empty((0, 0)), []
    if corners.ndim != 2 or len(corners) < 3:
        raise _wrong(file, f"{where}: it must be rings of 3 corners or more, each x, y")
    if holes:
        number = "a hole" if len(holes) == 1 else f"{len(holes)} holes"
        _LOG.warning("%s: %s has %s, which is taken as filled", file, where, number)
    return corners
