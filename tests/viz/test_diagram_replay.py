"""The replay of a user's own diagram, against Drake's own account of its motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import (
    ConstantVectorSource,
    Gain,
    LogVectorOutput,
    VectorLog,
)
import pytest

from tests.helpers.browser import browser
from tests.helpers.pages import page_data
from tests.helpers.synthetic_results import car_result
from vcbf_drake import AddSafetyFilter, FilterSettings, InputSet, SphereObstacle
from vcbf_drake.disturbances import DisturbanceBounds
from vcbf_drake.plants import CarVehicle
from vcbf_drake.viz import ObstacleGeometry, VehicleGeometry, write_diagram_replay

LINK = """<link name="{0}"><inertial><mass value="1"/><origin xyz="0 0 -.25"/>
<inertia ixx=".02" iyy=".02" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><origin xyz="0 0 -.25"/>
<geometry><cylinder radius=".03" length=".5"/></geometry>
<material name="{0}"><color rgba="1 0 0 1"/></material></visual></link>"""
JOINT = """<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/>
<axis xyz="0 1 0"/><origin xyz="0 0 {3}"/></joint>"""
ARM = (
    f"<robot name='arm'>{LINK.format('upper')}{LINK.format('lower')}"
    f"{JOINT.format('shoulder', 'world', 'upper', 1.2)}"
    f"{JOINT.format('elbow', 'upper', 'lower', -0.5)}</robot>"
)
ANGLES = [2.0, 1.0]
STONE = SphereObstacle([2.5, 0.05], 0.4, margin=0.24)
CAR = [0.0, 0.0, 0.1, 0.0]


def arm(time_step: float = 0.0, name: str = "plant") -> tuple[Diagram, MultibodyPlant]:
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step)
    plant.set_name(name)
    Parser(plant).AddModelsFromString(ARM, "urdf")
    plant.Finalize()
    LogVectorOutput(plant.get_state_output_port(), builder, 0.01).set_name("states")
    diagram = builder.Build()
    diagram.set_name("an arm that falls")
    return diagram, plant


def car_loop() -> Diagram:
    """A car of one's own loop, with a filter and no scenario."""
    builder, vehicle = DiagramBuilder(), CarVehicle()
    scene_graph = builder.AddSystem(SceneGraph())
    car = builder.AddNamedSystem("plant", vehicle.make_plant())
    controller = builder.AddNamedSystem(
        "controller", vehicle.make_controller([5.0, 0.0])
    )
    safety = AddSafetyFilter(
        builder,
        plant=car,
        reference=controller.GetOutputPort("reference"),
        barriers=[STONE.barrier(gains=[3.0, 2.0])],
        input_set=InputSet.box([-3.0, -4.5], [3.0, 4.5]),
        bounds=DisturbanceBounds(0.0, 0.0, 0.0),
        settings=FilterSettings(period=0.02),
    )
    state = car.GetOutputPort("state")
    calm = builder.AddSystem(ConstantVectorSource([0.0])).get_output_port()
    estimate = safety.observer.GetOutputPort("disturbance_estimate")
    builder.Connect(state, controller.GetInputPort("state"))
    builder.Connect(estimate, controller.GetInputPort("disturbance_estimate"))
    builder.Connect(calm, car.GetInputPort("disturbance"))
    VehicleGeometry.AddToBuilder(builder, vehicle, state, scene_graph, "car")
    ObstacleGeometry.AddToBuilder(builder, [STONE], scene_graph)
    return builder.Build()


def test_an_arm_without_a_filter_moves_as_in_drake(tmp_path: Path) -> None:
    diagram, plant = arm()
    start = diagram.CreateDefaultContext()
    plant.SetPositions(plant.GetMyContextFromRoot(start), ANGLES)
    path = write_diagram_replay(diagram, tmp_path / "new" / "arm.html", 2.0, start)
    page = path.read_text(encoding="utf-8")
    assert page.count("<title>an arm that falls - vcbf_drake</title>") == 1
    data = page_data(page)
    assert data["plots"] == []
    (run,) = data["runs"]
    assert (len(run["path"]), run["time"][-1]) == (61, 2.0)
    # The elbow travels farthest; it is half a metre from the shoulder.
    simulator = Simulator(diagram, start)
    for k in (0, 17, 60):
        simulator.AdvanceTo(run["time"][k])
        angle = plant.GetPositions(plant.GetMyContextFromRoot(start))[0]
        elbow = [-0.5 * np.sin(angle), 0.0, 1.2 - 0.5 * np.cos(angle)]
        np.testing.assert_allclose(run["path"][k], elbow, atol=2e-3)


def test_the_context_is_left_as_it_was(tmp_path: Path) -> None:
    diagram, plant = arm()
    start = diagram.CreateDefaultContext()
    plant.SetPositions(plant.GetMyContextFromRoot(start), ANGLES)
    write_diagram_replay(diagram, tmp_path / "arm.html", 0.5, start)
    assert start.get_time() == 0.0
    positions = plant.GetPositions(plant.GetMyContextFromRoot(start))
    assert positions.tolist() == ANGLES


def test_a_filters_series_are_shown(tmp_path: Path) -> None:
    diagram = car_loop()
    start = diagram.CreateDefaultContext()
    start.SetContinuousState(CAR)
    path = write_diagram_replay(diagram, tmp_path / "car.html", 4.0, start, "Mine")
    data = page_data(path.read_text(encoding="utf-8"))
    (run,) = data["runs"]
    x, y, _ = np.array(run["path"]).T
    h = np.hypot(x - 2.5, y - 0.05) - 0.64
    np.testing.assert_allclose(run["barrier"], h, atol=2e-3)
    assert min(run["barrier"]) > 0.0
    assert np.abs(run["input0"]).max() <= 3.0 and np.abs(run["input1"]).max() <= 4.5
    assert [plot["title"] for plot in data["plots"]][2] == "Inputs"
    assert all(len(outline) >= 6 for outline in run["sets"]["outline"])


def fallen(time_step: float, name: str) -> tuple[Diagram, MultibodyPlant, VectorLog]:
    """The arm after a second of its fall, and what was logged of it."""
    diagram, plant = arm(time_step, name)
    simulator = Simulator(diagram)
    root = simulator.get_mutable_context()
    plant.SetPositions(plant.GetMyMutableContextFromRoot(root), ANGLES)
    simulator.AdvanceTo(1.0)
    return diagram, plant, diagram.GetSubsystemByName("states").FindLog(root)


@pytest.mark.parametrize(
    ("time_step", "name"), [(0.0, "plant"), (1e-3, "plant"), (0.0, "my arm")]
)
def test_a_log_is_replayed_without_a_simulation(
    tmp_path: Path, time_step: float, name: str
) -> None:
    diagram, plant, log = fallen(time_step, name)
    whose = plant if name == "my arm" else None
    path = write_diagram_replay(diagram, tmp_path / "arm.html", log=log, plant=whose)
    (run,) = page_data(path.read_text(encoding="utf-8"))["runs"]
    assert len(run["path"]) == 31 and run["time"][-1] == pytest.approx(1.0)
    angle = np.interp(run["time"], log.sample_times(), log.data()[0])
    elbow = [-0.5 * np.sin(angle), 0.0 * angle, 1.2 - 0.5 * np.cos(angle)]
    np.testing.assert_allclose(run["path"], np.transpose(elbow), atol=1e-3)
    arrays = {"time": log.sample_times() + 7.0, "state": log.data().T}
    again = write_diagram_replay(diagram, tmp_path / "b.html", log=arrays, plant=plant)
    (same,) = page_data(again.read_text(encoding="utf-8"))["runs"]
    assert same["path"] == run["path"] and same["time"] == run["time"]


def test_a_log_of_everything_has_its_plots(tmp_path: Path) -> None:
    log = car_result(end=2.0).log
    path = write_diagram_replay(car_loop(), tmp_path / "car.html", log=log)
    data = page_data(path.read_text(encoding="utf-8"))
    (run,) = data["runs"]
    np.testing.assert_allclose(run["path"][0][:2], log["state"][0, :2], atol=1e-3)
    np.testing.assert_allclose(run["barrier"], log["barriers"].min(axis=1), rtol=1e-4)
    assert run["limits"] == [[-3.0, 3.0], [-4.5, 4.5]] and len(data["plots"]) == 3


def test_a_log_that_is_of_nobody_says_so(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    diagram, _, log = fallen(0.0, "my arm")
    with pytest.raises(ValueError, match="plant: None; it must be the system whose"):
        write_diagram_replay(diagram, path, log=log)
    diagram, _, log = fallen(0.0, "plant")
    for wrong, words in (
        ({"log": {"state": log.data().T}}, "log: it has no time"),
        ({"log": {"time": [0.0], "state": [[1.0], [2.0]]}}, "1 times, 2 states"),
        ({"log": {"time": [0.0], "state": [[1.0]]}}, "a state of 4 numbers"),
        ({"log": {"time": [0.0], "state": [[np.nan]]}}, r"log\.state\[0\]: nan"),
        ({"log": {"time": [np.inf], "state": [[1.0]]}}, r"log\.time\[0\]: inf"),
        ({"log": {"time": [1.0, 0.0], "state": [[1.0], [2.0]]}}, "do not go back"),
        ({"log": 3}, "a VectorLog, or arrays by name"),
        ({"duration": -1.0}, "duration: -1; it must be finite and above 0"),
        ({"duration": np.nan}, "duration: nan"),
        ({"log": log, "duration": 1.0}, "duration, log: one of the two"),
        ({}, "duration, log: one of the two"),
    ):
        with pytest.raises(ValueError, match=words):
            write_diagram_replay(diagram, path, **wrong)
    assert not path.exists()


def test_what_cannot_be_shown_is_refused_in_one_line(tmp_path: Path) -> None:
    builder = DiagramBuilder()
    builder.AddSystem(Gain(1.0, 1))
    diagram = builder.Build()
    diagram.set_name("plain")
    with pytest.raises(ValueError, match="diagram plain: it has no SceneGraph"):
        write_diagram_replay(diagram, tmp_path / "page.html", 1.0)
    builder = DiagramBuilder()
    builder.AddSystem(SceneGraph())
    with pytest.raises(ValueError, match="nothing in it has the illustration role"):
        write_diagram_replay(builder.Build(), tmp_path / "page.html", 1.0)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_browser_shows_it(tmp_path: Path) -> None:
    diagram, plant = arm()
    start = diagram.CreateDefaultContext()
    plant.SetPositions(plant.GetMyContextFromRoot(start), ANGLES)
    path = write_diagram_replay(diagram, tmp_path / "arm.html", 2.0, start)
    meshes = (
        "(() => { let n = 0; viewer.scene_tree.find(['drake', 'frames']).object"
        ".traverse((each) => { if (each.isMesh) n += 1; });"
        " return n < 2 ? null : n; })()"
    )
    with browser() as tab:
        tab.open(path.as_uri() + "#t=1")
        assert tab.settle(meshes) == 2
        height = "document.getElementById('meshcat-pane').clientHeight"
        assert tab.evaluate(f"window.innerHeight - {height}") < 60  # No plots.
        assert not tab.errors
