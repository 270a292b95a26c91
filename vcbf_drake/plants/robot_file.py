"""A robot's description in a file, URDF or SDFormat, read into a MultibodyPlant."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
import logging
import math
from pathlib import Path
import tempfile
import xml.etree.ElementTree as ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.parsing import PackageMap, Parser
from pydrake.multibody.plant import MultibodyPlant

from vcbf_drake.checks import Array, require, require_choice
from vcbf_drake.errors import InvalidValueError
from vcbf_drake.files import IS_FILE
from vcbf_drake.model.multibody_parts import (
    actuators_of,
    bodies_of,
    how_to_fix,
    joints_of,
)
from vcbf_drake.typed import NotNegative, Positive

_KINDS = (".urdf", ".sdf")
_STL = ".stl"
_CELLS = 100  # The resolution of a drawn mesh: positions along its longest side.
# The meshes that are drawn: those of Meshcat, and STL, which is converted.
_DRAWN = (".obj", ".gltf", ".glb", _STL)
_LOGGER = logging.getLogger("vcbf_drake")
_INERTIA = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


@dataclass
class RobotFile:
    """A robot's file, and the changes made to it.

    Attributes:
        file: Path of the file, relative to the scenario's, or ``package://NAME/...``.
        weld: The body to fix to the world; empty if the file fixes one, or the base
            floats.
        actuators: The actuated joints; empty for those of the file, or all joints if it
            declares none.
        fixed: The locked joints, for example a gripper's.
        mass: Ratio of masses and inertias to those of the file.
        drag: Ratio of joint dampings to those of the file.
    """

    file: str = field(metadata=IS_FILE)
    weld: str = field(default="", kw_only=True)
    actuators: list[str] = field(default_factory=list, kw_only=True)
    fixed: list[str] = field(default_factory=list, kw_only=True)
    mass: Positive = field(default=1.0, kw_only=True)
    drag: NotNegative = field(default=1.0, kw_only=True)

    def parse(self, scene_graph: SceneGraph | None = None) -> MultibodyPlant:
        """Returns the robot's continuous plant, with its geometry for a scene graph."""
        plant = MultibodyPlant(0.0)
        if scene_graph is not None:
            plant.RegisterAsSourceForSceneGraph(scene_graph)
        parser = Parser(plant)
        path = self._path(parser.package_map())
        shown = None if scene_graph is None else parser.package_map()
        try:
            robot = ElementTree.parse(path).getroot()
            efforts = dict(_efforts(robot))
            self._change(robot, path, shown)
            text = ElementTree.tostring(robot, "unicode")
            with _warned_once(self.file):
                parser.AddModelsFromString(text, path.suffix[1:])
        except InvalidValueError:
            raise
        except (RuntimeError, ValueError, ElementTree.ParseError) as error:
            problem = f"{self.file!r}; Drake does not read it: {error}"
            raise InvalidValueError("file", " ".join(problem.split())) from None
        self._choose_actuators(plant, efforts)
        self._weld(plant)
        for joint in joints_of(plant):
            damping = self.drag * joint.default_damping_vector()
            joint.set_default_damping_vector(damping)
        try:
            plant.Finalize()
            context = plant.CreateDefaultContext()
            plant.get_actuation_input_port().FixValue(
                context, np.zeros(plant.num_actuators())
            )
            plant.EvalTimeDerivatives(context)
        except RuntimeError as error:
            reason = " ".join(str(error).split())
            way_out = how_to_fix(plant) if plant.is_finalized() else ""
            problem = f"it does not move: {reason}{way_out}"
            raise InvalidValueError((), problem) from None
        return plant

    def _path(self, packages: PackageMap) -> Path:
        """The path of the file, after the packages around it have been found."""
        packages.Add("vcbf_drake", str(files("vcbf_drake")))
        packages.PopulateFromRosPackagePath()
        rule = f"a URDF or SDFormat file ({', '.join(_KINDS)}) that there is"
        if self.file.startswith("package://"):
            name = self.file.removeprefix("package://").partition("/")[0]
            known = ", ".join(sorted(packages.GetPackageNames()))
            rule += f"; packages are {known}, and those of ROS_PACKAGE_PATH"
            require(packages.Contains(name), "file", self.file, rule)
            try:
                path = Path(packages.ResolveUrl(self.file))
            except RuntimeError:
                path = Path()
        else:
            path = Path(self.file).resolve()
        require(path.is_file() and path.suffix in _KINDS, "file", self.file, rule)
        for above in path.parents[:-1]:
            if (above / "package.xml").is_file():
                with suppress(RuntimeError):  # Another package has the same name.
                    packages.AddPackageXml(str(above / "package.xml"))
        for above in path.parents[:-1]:  # An installed package is often its folder.
            if not packages.Contains(above.name):
                packages.Add(above.name, str(above))
        return path

    def _change(self, robot: Element, path: Path, packages: PackageMap | None) -> None:
        """Fixes joints, scales masses and finds meshes.

        Only geometry that can be drawn is kept, or none without packages: Drake would
        reject a file for some other geometry.
        """
        if robot.tag == "robot" and not robot.get("name"):
            robot.set("name", path.stem)
        self._fix_joints(robot)
        for each in robot.iter():
            if each.tag in ("mass", "inertia", *_INERTIA) and self.mass != 1.0:
                _multiply(each, self.mass)
            if "://" not in (url := each.get("filename", "://")):
                each.set("filename", (path.parent / url).resolve().as_uri())
            if each.tag == "uri" and "://" not in (each.text or "://"):
                each.text = (path.parent / str(each.text).strip()).resolve().as_uri()
        links = [*robot.iter("link")]
        rods = [str(each.get("name")) for each in links if not _draw(each, packages)]
        if rods:
            drawn, names = ", ".join(_DRAWN), ", ".join(rods)
            _tell(f"{self.file}: meshes that are drawn are {drawn}; rods for {names}")

    def _fix_joints(self, robot: Element) -> None:
        """Fixes joints; Drake has those that mimic others only in discrete time."""
        joints = {
            each.attrib["name"]: each
            for each in robot.iter("joint")
            if "type" in each.attrib  # A transmission names its joint too.
        }
        for name in self.fixed:
            require_choice("fixed", name, [*joints])
            joints[name].set("type", "fixed")
        for each in robot.findall("transmission"):
            if {joint.get("name") for joint in each.iter("joint")} <= {*self.fixed}:
                robot.remove(each)
        mimics = []
        for name, joint in joints.items():
            for parent in (joint, *joint.findall("axis")):
                for each in parent.findall("mimic"):
                    if joint.get("type") == "fixed":
                        parent.remove(each)
                    else:
                        mimics.append(name)
        if mimics:
            problem = "joints that mimic others move in discrete time alone; add"
            raise InvalidValueError("fixed", f"{problem} {', '.join(mimics)}")

    def _choose_actuators(
        self, plant: MultibodyPlant, efforts: Mapping[str, float]
    ) -> None:
        """Gives a motor to the chosen joints alone."""
        joints = {
            each.name(): each for each in joints_of(plant) if each.num_velocities() == 1
        }
        has = {each.joint().name(): each for each in actuators_of(plant)}
        wanted = self.actuators or [*has] or [*joints]
        require(bool(wanted), "file", self.file, "a robot with joints that move")
        for name in wanted:
            require_choice("actuators", name, [*joints])
            if name not in has:
                effort = efforts.get(name, math.inf)
                plant.AddJointActuator(name, joints[name], effort)
        for name, actuator in has.items():
            if name not in wanted:
                plant.RemoveJointActuator(actuator)

    def _weld(self, plant: MultibodyPlant) -> None:
        if not self.weld:
            return
        bodies = {each.name(): each for each in bodies_of(plant)}
        require_choice("weld", self.weld, [*bodies])
        try:
            plant.WeldFrames(plant.world_frame(), bodies[self.weld].body_frame())
        except RuntimeError:
            rule = "empty, for the file has fixed it already"
            require(False, "weld", self.weld, rule)


@cache
def _tell(message: str) -> None:
    """Logs a message once."""
    _LOGGER.warning(message)


@contextmanager
def _warned_once(file: str) -> Iterator[None]:
    """Suppresses Drake's warnings about a file when it is read again."""
    logger = logging.getLogger("drake")
    level = logger.level
    if file in _READ:
        logger.setLevel(logging.ERROR)
    _READ.add(file)
    try:
        yield
    finally:
        logger.setLevel(level)


_READ: set[str] = set()


def _multiply(element: Element, factor: float) -> None:
    """Multiplies an element's numbers: attributes in URDF, its text in SDFormat."""
    for name in set(element.keys()) & {"value", *_INERTIA}:
        element.set(name, repr(factor * float(element.attrib[name])))
    if (element.text or "").strip():
        element.text = repr(factor * float(str(element.text)))


def _efforts(robot: Element) -> Iterator[tuple[str, float]]:
    """The effort limits of a file's joints, which Drake keeps only for motors."""
    for joint in robot.iter("joint"):
        for limit in joint.iter("limit"):
            effort = limit.get("effort") or limit.findtext("effort")
            if effort is not None and float(effort) > 0.0:
                yield str(joint.get("name")), float(effort)


def _draw(link: Element, packages: PackageMap | None) -> bool:
    """Keeps a link's shapes that Drake draws, STL meshes as Wavefront.

    If none of its visual shapes can be drawn, the collision shapes replace them. None
    of them is kept without packages. Returns whether a shape remains.
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
        if file.suffix.lower() not in _DRAWN or not file.is_file():
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
