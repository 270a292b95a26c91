"""A robot's file: what is read of it, what may be changed, what is refused."""

from __future__ import annotations

from pathlib import Path
import shutil
import struct

import numpy as np
from pydrake.common import FindResourceOrThrow
from pydrake.geometry import Box, Capsule
from pydrake.multibody.plant import MultibodyPlant
import pytest

from vcbf_drake import load_scenario
from vcbf_drake.errors import InvalidValueError
from vcbf_drake.model.multibody_parts import bodies_of
from vcbf_drake.plants import MultibodyVehicle, Part
from vcbf_drake.plants.robot_file import RobotFile
from vcbf_drake.plants.shapes import bounding_box
from vcbf_drake.simulation import dump_scenario
from vcbf_drake.simulation.loading import parse_scenario

ROOT = Path(__file__).parents[2]
ARM = "package://vcbf_drake/models/seven_joint_arm.urdf"
PLANAR = str(ROOT / "examples" / "models" / "planar_arm.urdf")
CART_POLE_FILE = "drake/examples/multibody/cart_pole/cart_pole.sdf"
CART_POLE = f"package://{CART_POLE_FILE}"


def mass_matrix(plant: MultibodyPlant) -> np.ndarray:
    context = plant.CreateDefaultContext()
    q = np.linspace(0.3, 0.9, plant.num_positions())
    plant.SetPositions(context, q)
    return plant.CalcMassMatrix(context)


def damping_force(plant: MultibodyPlant) -> np.ndarray:
    """The generalised force of the dampers at unit speeds, by M dv/dt."""
    context = plant.CreateDefaultContext()
    motors = plant.get_actuation_input_port()
    motors.FixValue(context, np.zeros(plant.num_actuators()))
    found = []
    for speed in (1.0, -1.0):
        plant.SetVelocities(context, speed * np.ones(plant.num_velocities()))
        rate = plant.EvalTimeDerivatives(context).get_generalized_velocity()
        found.append(plant.CalcMassMatrix(context) @ rate.CopyToVector())
    return 0.5 * (found[0] - found[1])  # What is even in the speeds drops out.


@pytest.mark.parametrize("file", [ARM, CART_POLE, PLANAR])
def test_masses_and_dampings_scale(file: str) -> None:
    weld = "base" if file == ARM else ""
    whole = RobotFile(file, weld=weld).parse()
    heavy = RobotFile(file, weld=weld, mass=1.3, drag=0.5).parse()
    M = mass_matrix(whole)
    np.testing.assert_allclose(mass_matrix(heavy), 1.3 * M, rtol=1e-12, atol=1e-15)
    damp = damping_force(whole)
    np.testing.assert_allclose(damping_force(heavy), 0.5 * damp, rtol=1e-9, atol=1e-9)
    assert file == CART_POLE or np.abs(damp).min() > 0.01
    assert heavy.GetStateNames() == whole.GetStateNames()


def test_joints_may_be_fixed_and_motors_chosen() -> None:
    plant = RobotFile(
        ARM,
        weld="base",
        actuators=["joint_2", "joint_4"],
        fixed=["joint_6", "joint_7"],
    ).parse()
    assert plant.num_positions() == 5
    motors = map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
    assert [each.joint().name() for each in motors] == ["joint_2", "joint_4"]
    assert plant.GetEffortUpperLimits().tolist() == [300.0, 170.0]
    # All masses are still there.
    whole = RobotFile(ARM, weld="base").parse()
    masses = [sum(each.default_mass() for each in bodies_of(p)) for p in (plant, whole)]
    assert masses[0] == pytest.approx(masses[1])


def test_motors_of_a_file_without_them_keep_its_efforts(tmp_path: Path) -> None:
    text = Path(PLANAR).read_text()
    start, end = text.index("<transmission"), text.rindex("</transmission>")
    file = tmp_path / "planar_arm.urdf"
    file.write_text(text[:start] + text[end + len("</transmission>") :])
    plant = RobotFile(str(file), actuators=["shoulder"]).parse()
    assert plant.GetEffortUpperLimits().tolist() == [80.0]
    plant = RobotFile(str(file)).parse()  # A motor at each.
    assert plant.GetEffortUpperLimits().tolist() == [80.0, 40.0]


SCENARIO = """
reach:
  vehicle: !Multibody {file: robots/arm.urdf, frame: forearm, point: [0.5, 0, 0]}
  initial_state: [0.5, 0.5, 0, 0]
  target: [0.8, 0.0, 1.3]
  method: cbf-qp
"""


def test_a_file_is_found_beside_the_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "robots").mkdir()
    shutil.copy(PLANAR, tmp_path / "robots" / "arm.urdf")
    (tmp_path / "reach.yaml").write_text(SCENARIO)
    monkeypatch.chdir(ROOT)
    scenario = load_scenario(tmp_path / "reach.yaml")
    assert scenario.vehicle.file == str(tmp_path / "robots" / "arm.urdf")
    # A copy elsewhere still finds it.
    assert parse_scenario(dump_scenario(scenario), "elsewhere/dump.yaml") == scenario
    # An override is written where the command runs.
    override = "{vehicle: {file: examples/models/planar_arm.urdf}}"
    assert load_scenario(tmp_path / "reach.yaml", override).vehicle.file == PLANAR


def test_packages_around_the_file_are_known(tmp_path: Path) -> None:
    (tmp_path / "package.xml").write_text("<package><name>mine</name></package>")
    (tmp_path / "sdf").mkdir()
    shutil.copy(FindResourceOrThrow(CART_POLE_FILE), tmp_path / "sdf" / "cart.sdf")
    (tmp_path / "two.sdf").write_text(
        "<sdf version='1.7'><model name='two'><include><uri>package://mine/sdf/cart.sdf"
        "</uri></include></model></sdf>"
    )
    assert RobotFile(str(tmp_path / "two.sdf")).parse().num_positions() == 2


def test_joints_that_mimic_others_have_to_be_fixed(tmp_path: Path) -> None:
    text = Path(PLANAR).read_text().replace('<robot name="planar_arm">', "<robot>")
    mark = '<joint name="elbow" type="revolute">'
    file = tmp_path / "mimic.urdf"
    file.write_text(text.replace(mark, f"{mark}<mimic joint='shoulder'/>"))
    with pytest.raises(InvalidValueError, match=r"^fixed: joints that mimic .* elbow$"):
        RobotFile(str(file)).parse()
    plant = RobotFile(str(file), fixed=["elbow"]).parse()
    assert plant.GetStateNames() == ["mimic_shoulder_q", "mimic_shoulder_w"]


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        (RobotFile("package://nowhere/a.urdf"), "packages are drake, "),
        (
            RobotFile("package://drake/a.urdf"),
            "a URDF or SDFormat file .* that there is",
        ),
        (RobotFile(__file__), r"a URDF or SDFormat file \(.urdf, .sdf\)"),
        (RobotFile(ARM), "it does not move: .* body base .*; weld: base fixes the"),
        (
            RobotFile(ARM, weld="base", fixed=["joint_9"]),
            "fixed: 'joint_9'; .* joint_1",
        ),
        (RobotFile(PLANAR, weld="stand"), "weld: 'stand'; .* has fixed it already"),
        (RobotFile(ARM, weld="floor"), "weld: 'floor'; it must be one of base"),
        (
            RobotFile(ARM, weld="base", actuators=["elbow"]),
            "actuators: 'elbow'; it must be one of joint_1",
        ),
    ],
)
def test_wrong_files_are_refused_in_one_line(robot: RobotFile, message: str) -> None:
    with pytest.raises(InvalidValueError, match=message) as caught:
        robot.parse()
    assert "\n" not in str(caught.value)


CORNERS = np.array([[0.0, 0, 0], [0.2, 0, 0], [0, 0.3, 0], [0, 0, 0.4]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def write_stl(file: Path, in_words: bool) -> None:
    """A tetrahedron, in one of the format's two forms."""
    if in_words:
        corners = [
            "\n".join(f"vertex {x} {y} {z}" for x, y, z in CORNERS[face])
            for face in FACES
        ]
        facet = "facet normal 0 0 0\nouter loop\n{}\nendloop\nendfacet"
        text = ["solid t", *map(facet.format, corners), "endsolid t"]
        file.write_text("\n".join(text))
        return
    facets = [
        struct.pack("<12fH", 0, 0, 0, *CORNERS[face].ravel(), 0) for face in FACES
    ]
    header = b"tetrahedron".ljust(80) + struct.pack("<I", len(FACES))
    file.write_bytes(header + b"".join(facets))


def robot_with(tmp_path: Path, visual: str, collision: str = "") -> MultibodyVehicle:
    """The planar arm with other shapes on its upper arm."""
    shape = "<{0}><geometry>{1}</geometry></{0}>"
    text = Path(PLANAR).read_text()
    start, end = text.index("<visual>", text.index("upper_arm")), text.index("forearm")
    end = text.rindex("</visual>", 0, end) + len("</visual>")
    shapes = shape.format("visual", visual)
    shapes += shape.format("collision", collision) if collision else ""
    (tmp_path / "arm.urdf").write_text(text[:start] + shapes + text[end:])
    return MultibodyVehicle(str(tmp_path / "arm.urdf"), "forearm")


def shown(vehicle: MultibodyVehicle) -> list[Part]:
    return [each for each in vehicle.geometry("#123456") if each.body == "upper_arm"]


@pytest.mark.parametrize("in_words", [True, False])
@pytest.mark.parametrize("name", ["part.stl", "part.STL"])
def test_stl_meshes_are_drawn_at_their_size(
    tmp_path: Path, in_words: bool, name: str
) -> None:
    write_stl(tmp_path / name, in_words)
    mesh = f"<mesh filename='{name}' scale='0.5 0.5 0.5'/>"
    (part,) = shown(robot_with(tmp_path, mesh))
    low, high = bounding_box([part])
    np.testing.assert_allclose(low, 0.0, atol=1e-3)
    np.testing.assert_allclose(high, [0.1, 0.15, 0.2], atol=1e-3)


def test_meshes_that_are_not_drawn_are_their_collision_shapes_or_rods(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "part.dae").touch()
    mesh = "<mesh filename='part.dae'/>"
    (part,) = shown(robot_with(tmp_path, mesh, "<box size='0.1 0.2 0.3'/>"))
    assert isinstance(part.shape, Box)
    assert not caplog.records
    beside, elsewhere = (
        f"<mesh filename='{name}'/>" for name in ("nowhere.obj", "package://no/a.stl")
    )
    for missing in (mesh, beside, elsewhere, mesh):
        (rod,) = shown(robot_with(tmp_path, missing, missing))
        # From the shoulder to the elbow, 0.7 m along x.
        assert isinstance(rod.shape, Capsule)
        assert rod.shape.length() == pytest.approx(0.7)
        np.testing.assert_allclose(rod.pose.translation(), [0.35, 0, 0], atol=1e-12)
    (record,) = caplog.records
    assert record.message.endswith("rods for upper_arm")
    assert ".stl" in record.message


def test_a_wavefront_mesh_beside_the_file_is_drawn(tmp_path: Path) -> None:
    lines = [*(f"v {x} {y} {z}" for x, y, z in CORNERS)]
    lines += [f"f {a} {b} {c}" for a, b, c in FACES + 1]
    (tmp_path / "part.obj").write_text("\n".join([*lines, ""]))
    (part,) = shown(robot_with(tmp_path, "<mesh filename='part.obj'/>"))
    np.testing.assert_allclose(bounding_box([part])[1], [0.2, 0.3, 0.4], atol=1e-9)
