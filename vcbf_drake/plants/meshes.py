"""The geometry of a robot's file that Drake draws, with STL meshes converted."""

from __future__ import annotations

from functools import cache
from pathlib import Path
import tempfile
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.multibody.parsing import PackageMap

from vcbf_drake.checks import Array

_STL = ".stl"
_CELLS = 100  # The resolution of a drawn mesh: positions along its longest side.
# The meshes that are drawn: those of Meshcat, and STL, which is converted.
DRAWN = (".obj", ".gltf", ".glb", _STL)


def draw(link: Element, packages: PackageMap | None) -> bool:
    """Keeps a link's shapes that Drake draws, STL meshes as Wavefront.

    If none of its visual shapes can be drawn, the collision shapes replace them.

    Args:
        link: The link, which is changed.
        packages: The packages of the meshes' URLs; None for no geometry.

    Returns:
        Whether a shape remains.
    """
    visuals, collisions = link.findall("visual"), link.findall("collision")
    for each in [*visuals, *collisions]:
        link.remove(each)
    if packages is None:
        return True
    shown = [each for each in visuals if _is_drawn(each, packages)]
    if visuals and not shown:
        shown = [each for each in collisions if _is_drawn(each, packages)]
    for each in shown:
        each.tag = "visual"
        link.append(each)
    return bool(shown) or not visuals


def _is_drawn(shape: Element, packages: PackageMap) -> bool:
    """Whether a shape's meshes exist and are drawn; STL meshes are converted."""
    for mesh in shape.iter("mesh"):
        uri = mesh.find("uri")
        url = str(mesh.get("filename") if uri is None else uri.text)
        try:
            file = Path(packages.ResolveUrl(url))
        except RuntimeError:
            return False
        if file.suffix.lower() not in DRAWN or not file.is_file():
            return False
        if file.suffix.lower() == _STL:
            converted = _wavefront(file).as_uri()
            if uri is None:
                mesh.set("filename", converted)
            else:
                uri.text = converted
    return True


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    """The folder of converted meshes, removed when the process ends."""
    return tempfile.TemporaryDirectory(prefix="vcbf_drake_")


@cache
def _wavefront(file: Path) -> Path:
    """Returns the path of a Wavefront file with the triangles of an STL file.

    Corners that a picture cannot distinguish are merged, so that a replay stays small.
    """
    found = _corners(file)
    cell = max(float(np.ptp(found, axis=0).max()) / _CELLS, 1e-9)
    places = np.round(found / cell)
    points, corners = np.unique(places, axis=0, return_inverse=True)
    points, triangles = cell * points, 1 + corners.reshape(-1, 3)
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in points.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in triangles.tolist()]
    made = Path(tempfile.mkdtemp(dir=_folder().name)) / f"{file.stem}.obj"
    made.write_text("\n".join([*lines, ""]), encoding="ascii")
    return made


def _corners(file: Path) -> Array:
    """The corners of an STL file's k triangles, shape (3 k, 3)."""
    data = file.read_bytes()
    count = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + 50 * count:  # Otherwise the file is in the text format.
        triangle = np.dtype([("normal", "<f4", 3), ("at", "<f4", (3, 3)), ("", "<u2")])
        found = np.frombuffer(data, triangle, offset=84)["at"]
        return found.reshape(-1, 3).astype(float)
    words = map(str.split, data.decode("ascii", "replace").splitlines())
    return np.array(
        [each[1:4] for each in words if each[:1] == ["vertex"]], dtype=float
    )
