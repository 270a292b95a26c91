"""Every public constructor, given what does not belong: one line that says where."""

from dataclasses import fields, is_dataclass, replace
import inspect
import math
from pathlib import Path
import traceback

import numpy as np
from pydrake.systems.framework import DiagramBuilder
from pydrake.trajectories import PiecewisePolynomial
import pytest

import vcbf_drake as v
from vcbf_drake.barriers import MovingObstacle, PolygonObstacle, all_of
from vcbf_drake.plants import MultibodyVehicle
from vcbf_drake.plants.robot_controllers import InverseDynamics, JointStiffness, Lqr
from vcbf_drake.simulation import (
    BodyPoint,
    PolygonMap,
    SpheresFile,
    scenario_schema,
)
from vcbf_drake.simulation.faults import Faults, StepGust
from vcbf_drake.simulation.sections import (
    BarrierGains,
    Hardware,
    Integrator,
    MeasurementNoise,
    Separation,
)

PACKAGE = str(Path(v.__file__).parent)
ARM = "package://vcbf_drake/models/seven_joint_arm.urdf"
CAR = v.ControlAffineModel.from_system(v.Car())
BOUNDS = v.DisturbanceBounds(0.1, 0.1, 0.1)
BOX = v.InputSet.box([-1.0, -1.0], [1.0, 1.0])
DISC = v.SphereObstacle([3.0, 0.1], 0.5)
BARRIER = DISC.barrier([2.0, 1.0])
SCENARIO = v.load_scenario("car-avoidance")
SCENARIO_KEYS = [each.name for each in fields(v.Scenario)]
PATH = PiecewisePolynomial.FirstOrderHold([0.0, 1.0], [[0.0, 1.0], [0.0, 0.0]])


def add_filter(**changes):
    builder = DiagramBuilder()
    car = builder.AddSystem(v.Car())
    controller = builder.AddSystem(v.CarController([6.0, 0.0]))
    builder.Connect(car.get_output_port(), controller.GetInputPort("state"))
    given = {
        "plant": car,
        "reference": controller.GetOutputPort("reference"),
        "barriers": [BARRIER],
        "input_set": BOX,
        "bounds": BOUNDS,
    }
    v.AddSafetyFilter(changes.pop("builder", builder), **(given | changes))


def arm():
    return MultibodyVehicle(ARM, "hand", weld="base").make_plant()


# What is made, and arguments that are right.
MADE = [
    (v.SphereObstacle, {"center": [0.0, 0.0], "radius": 1.0, "velocity": [1.0, 0.0]}),
    (v.EllipsoidObstacle, {"center": [0.0, 0.0], "semi_axes": [1.0, 2.0]}),
    (v.BoxObstacle, {"center": [0.0, 0.0], "half_widths": [1.0, 2.0]}),
    (v.CapsuleObstacle, {"start": [0.0, 0.0], "end": [1.0, 2.0], "radius": 1.0}),
    (v.HalfSpace, {"normal": [1.0, 0.0]}),
    (v.Geofence, {"lower": [0.0, 0.0], "upper": [1.0, 1.0]}),
    (v.PairDistance, {"distance": 1.0}),
    (v.PerceivedSpheres, {"capacity": 2}),
    (v.StateLimit, {"state": 2, "lower": -1.0, "upper": 1.0}),
    (PolygonObstacle, {"vertices": [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]}),
    (v.Barrier, {"function": lambda x, t, p: x[0], "gains": [1.0]}),
    (BARRIER.robust_to, {"bound": 0.1}),
    (BARRIER.with_class_k, {"class_k": lambda s: s**3}),
    (DISC.barrier, {"gains": [2.0, 1.0], "position": [0, 1]}),
    (DISC.barrier_along, {"trajectory": PATH, "gains": [2.0, 1.0]}),
    (v.Geofence([0, 0], [1, 1]).barriers, {"gains": [2.0, 1.0], "position": [0, 1]}),
    (v.StateLimit(2, 0.0).barriers, {"gains": [1.0]}),
    (v.PerceivedSpheres(2).barriers, {"gains": [2.0, 1.0], "position": [0, 1, 2]}),
    (
        v.PairDistance(1.0).barrier,
        {"gains": [2.0, 1.0], "first": [0, 1], "second": [2, 3]},
    ),
    (all_of, {"barriers": [BARRIER, BARRIER], "smoothing": 0.1}),
    (v.StateInputLimit, {"function": lambda x, t, p: ([1.0, 0.0], 1.0)}),
    (v.ackermann_limit, {"curvature": 1.0, "smoothing_speed": 0.1}),
    (v.BarrierSet, {"model": CAR, "barriers": [BARRIER]}),
    (v.DisturbanceBounds, {"delta1": 0.1, "delta2": 0.1, "delta3": 0.1}),
    (v.ObserverSettings, {}),
    (v.RiseObserver, {"model": CAR, "period": 0.02, "bounds": BOUNDS}),
    (
        v.LinearDisturbanceObserver,
        {"model": CAR, "period": 0.02, "bounds": BOUNDS, "rate": 1.0},
    ),
    (v.DisturbanceSource, {"signals": [v.Constant([0.1])]}),
    (lambda **given: v.Constant(**given).curve(1.0), {"value": [0.1]}),
    (lambda **given: v.Sinusoid(**given).curve(1.0), {"amplitude": [0.1]}),
    (lambda **given: v.SmoothStep(**given).curve(1.0), {"amplitude": [0.1]}),
    (lambda **given: v.BandLimitedNoise(**given).curve(1.0), {"std": [0.1]}),
    (
        lambda **given: v.Recorded(**given).curve(1.0),
        {"times": [0.0, 0.5, 1.0], "values": [[0.0], [0.1], [0.0]]},
    ),
    (v.ControlAffineModel.from_system, {"system": v.Car()}),
    (v.Blimp, {"parameters": v.BlimpParameters()}),
    (v.Car, {"parameters": v.CarParameters()}),
    (v.BlimpParameters, {}),
    (v.CarParameters, {}),
    (v.BlimpControllerParameters, {}),
    (v.CarControllerParameters, {}),
    (v.BlimpController, {"target": [1.0, 2.0, 3.0]}),
    (v.CarController, {"target": [1.0, 2.0]}),
    (
        v.StateFeedback,
        {"law": lambda x: [0.0], "num_states": 2, "num_inputs": 1},
    ),
    (v.InputSet, {"A": [[1.0], [-1.0]], "b": [1.0, 1.0]}),
    (v.InputSet.box, {"lower": [-1.0], "upper": [1.0]}),
    (v.point_position, {"plant": arm(), "frame": "hand"}),
    (v.VolumeBarrier, {}),
    (v.FilterSettings, {}),
    (v.Corrections, {}),
    (v.SafetyFilter, {"model": CAR, "barriers": [BARRIER], "input_set": BOX}),
    (add_filter, {}),
    (v.InputLimits, {"lower": [-1.0], "upper": [1.0]}),
    (
        MovingObstacle,
        {
            "shape": v.BoxObstacle([0.0, 0.0], [1.0, 1.0]),
            "times": [0.0, 1.0],
            "waypoints": [[0.0, 0.0], [1.0, 0.0]],
        },
    ),
    (SpheresFile, {"file": "discs.csv"}),
    (PolygonMap, {"file": "map.geojson"}),
    (BodyPoint, {}),
    (InverseDynamics, {}),
    (JointStiffness, {}),
    (Lqr, {}),
    (Faults, {}),
    (StepGust, {"amplitude": [0.1], "start": 0.0, "duration": 1.0}),
    (BarrierGains, {}),
    (Hardware, {}),
    (Integrator, {}),
    (MeasurementNoise, {}),
    (MultibodyVehicle, {"file": ARM, "frame": "hand", "weld": "base"}),
    (Separation, {}),
    (v.Fleet, {"vehicles": [SCENARIO]}),
    (v.load_fleet, {"name_or_path": "car-avoidance"}),
    (v.load_scenario, {"name_or_path": "car-avoidance"}),
    (
        lambda **given: v.Scenario(**given),
        {key: getattr(SCENARIO, key) for key in SCENARIO_KEYS},
    ),
    (v.simulate, {"scenario": replace(SCENARIO, duration=0.1)}),
]

WRONG = {
    "None": None,
    "text": "a",
    "number": 3.7,
    "nan": math.nan,
    "nan in a list": [math.nan],
    "nested": [[0.0]],
    "ragged": [[0.0, 1.0], [2.0]],
    "texts": ["a", "b"],
    "array": np.zeros((2, 2, 2)),
    "mapping": {},
    "object": object(),
}

MATRICES = ("A", "input_weights")


def parameters(make, right):
    if make is add_filter:
        return list(inspect.signature(v.AddSafetyFilter).parameters)
    if make in (v.Blimp, v.Car):
        return ["parameters"]
    if is_dataclass(make):
        return [each.name for each in fields(make)]
    found = list(inspect.signature(make).parameters)
    return list(right) if found == ["given"] else found


CASES = [
    pytest.param(make, right, name, id=f"{getattr(make, '__qualname__', make)}-{name}")
    for make, right in MADE
    for name in parameters(make, right)
]


@pytest.mark.parametrize(("make", "right", "name"), CASES)
def test_what_does_not_belong_is_refused_in_one_line(
    make, right, name, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for kind, wrong in WRONG.items():
        try:
            make(**(right | {name: wrong}))
        except (v.VcbfError, ValueError) as error:
            message = str(error)
            raised_in = traceback.extract_tb(error.__traceback__)[-1].filename
            assert raised_in.startswith(PACKAGE), (kind, message)
            assert "\n" not in message and len(message) < 400, kind
            # A file's error says which file; one in a matrix, what belongs to it.
            says = name in message or "input port" in message
            by_name = (v.load_fleet, v.load_scenario, v.simulate)
            elsewhere = make in by_name or name in MATRICES
            assert says or elsewhere, (kind, message)
        else:
            # A number, None or a text belongs where the others of its kind do.
            belongs = ("None", "number", "text", "mapping")
            assert kind in belongs or (kind == "nested" and name in MATRICES), kind


def test_an_argument_that_does_not_exist_is_said_of_whom():
    with pytest.raises(TypeError, match=r"^AddSafetyFilter\(\) got an .*'period'"):
        add_filter(period=0.01)


@pytest.mark.parametrize(("make", "right"), MADE)
def test_what_belongs_is_taken(make, right):
    make(**right)


def test_every_part_of_a_scenario_file_is_in_the_table():
    """Or is one of these, which take what others in it take."""
    others = {"Scenario", "PartOfScenario", "BlimpVehicle", "CarVehicle", "TurnLimit"}
    signals = {"Constant", "Sinusoid", "SmoothStep", "BandLimitedNoise", "Recorded"}
    parts = set(scenario_schema()["$defs"])
    made = {make.__name__ for make, _ in MADE if isinstance(make, type)}
    assert parts - made == others | signals
