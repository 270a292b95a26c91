from __future__ import annotations

import copy
import dataclasses
from pathlib import Path
import random
import re
from typing import Any

import numpy as np
from pydrake.common.yaml import yaml_load
import pytest

from vcbf_drake.barriers import SphereObstacle
from vcbf_drake.checks import require
from vcbf_drake.errors import InvalidValueError, ScenarioError
from vcbf_drake.plants import BlimpVehicle, TurnLimit
from vcbf_drake.simulation import (
    InputLimits,
    Scenario,
    loading,
    simulate,
    validate,
)
from vcbf_drake.simulation.loading import (
    dump_scenario,
    load_scenario,
    merge_overrides,
    shipped_scenarios,
)
from vcbf_drake.typed import tag_of

SHIPPED = (
    "blimp-multiple-obstacles",
    "blimp-single-obstacle",
    "car-avoidance",
    "car-sensitivity",
)
DIRECTORY = Path(loading.__file__).parent / "scenarios"

ONE_OF_EVERYTHING = """\
_template: &wind
  frequency: 0.5
OneOfEverything:
  name: everything
  description: One of everything.
  vehicle: !Car
    mass: 1.5
    controller:
      turn_gain: 1.0
      speed_gain: 3.0
      approach_gain: 0.5
    turn_limit:
      curvature: 1.25
      smoothing_speed: 0.2
  input_set:
    lower: [-2.0, -1]
    upper: [2.0, 1.0]
    A: [[0.5, 1.0]]
    b: [1.5]
  disturbance:
    - !Constant {value: [1e-2]}
    - !Sinusoid {<<: *wind, amplitude: [0.1], phase: 0.3}
    - !SmoothStep {amplitude: [0.2], start: 1.0, duration: 2.0}
    - !BandLimitedNoise {std: [0.05], bandwidth: 3.0, seed: 4}
    - !Recorded
      times: [0.0, 1.0, 3.0, 6.0]
      values: [[0.0], [0.1], [-0.1], [0.0]]
  observer:
    period: 0.025
    alpha: 4.0
    beta: 5.0
    gamma: 3.0
    step: saturated
    boundary_layer: 0.02
    linear_rate: 2.0
  obstacles:
    - center: [2.0, 0.5]
      radius: 0.3
    - {center: [3.0, -0.5], radius: 0.3, velocity: [0.0, 0.1], margin: 0.05}
  separation: {distance: 0.5}
  barrier:
    form: squared
    gains: [4.0, 4.0]
  volume:
    threshold: 0.05
    gain: 2.0
    slack_penalty: 10.0
  method: vcbf-qp
  fidelity: !Corrections {exact_slack: true}
  infeasible: hold
  between_ticks: certified
  violation_weights: [1.0, 2.0]
  input_weights: [2.0, 1.0]
  soft_penalties: [.inf, 100.0]
  soft_linear_penalties: [0.0, 10.0]
  solver: Clp
  warn: true
  body: [{radius: 0.05}]
  decay_penalty: 50.0
  backup_margin: 0.1
  ends_at_target: true
  initial_state: [0.0, 0.0, 0.1, 0.2]
  target: [5.0, 0.0]
  duration: 6.0
  period: 0.05
  arrival_tolerance: 0.1
  integrator:
    scheme: runge_kutta2
    max_step: 0.01
  noise:
    std: [0.0, 0.0, 0.01, 0.0]
    seed: 3
  hardware:
    fallback: zero
    brake_rate: 1.0
    command_timeout: 0.2
    max_state_age: 0.3
    hold_time: 0.0
    longest_interval: 0.15
  faults:
    seed: 3
    measurement_bias: [0.01, 0.0, 0.0, 0.0]
    measurement_delay: 0.02
    measurement_loss: 0.1
    sight: 2.0
    actuator_lag: 0.05
    actuator_limit: 0.9
    mass: 1.1
    drag: 1.0
    disturbance: 1.5
    gusts:
      - {amplitude: [0.2], start: 1.0, duration: 0.5}
    solver_failure: 0.01
"""


SMALL = """{vehicle: !Blimp {}, initial_state: [0, 0, 0, 0, 0, 0, 0, 0],
 input_set: {lower: [-0.25, -0.25, -0.02], upper: [0.25, 0.25, 0.02]},
 target: [1, 0, 1]}"""


def blimp_scenario(**fields: Any) -> Scenario:
    """A scenario with defaults wherever there are some."""
    limits = InputLimits([-0.25, -0.25, -0.02], [0.25, 0.25, 0.02])
    return Scenario(
        vehicle=BlimpVehicle(),
        input_set=limits,
        initial_state=8 * [0.0],
        target=[1.0, 0.0, 1.0],
        **fields,
    )


@pytest.fixture
def everything(tmp_path: Path) -> Path:
    path = tmp_path / "everything.yaml"
    path.write_text(ONE_OF_EVERYTHING)
    return path


def refusal(*args: object, **kwargs: object) -> str:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(*args, **kwargs)  # type: ignore[arg-type]
    message = str(caught.value)
    assert "\n" not in message
    return message


# What loads ------------------------------------------------------------------------


def test_ships_its_scenarios() -> None:
    assert shipped_scenarios() == SHIPPED


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_scenario_is_what_drake_reads(name: str) -> None:
    scenario = load_scenario(name)
    drakes = yaml_load(filename=str(DIRECTORY / f"{name}.yaml"), private=True)[name]
    assert scenario.name == name
    check_holds(scenario, drakes)


def check_holds(value: object, read: object) -> None:
    """Checks a value against what Drake reads in the same text, without types."""
    if isinstance(read, dict):
        assert read.pop("_tag", tag_of(type(value))) == tag_of(type(value))
        for name, each in read.items():
            check_holds(getattr(value, name), each)
    elif isinstance(read, list):
        assert isinstance(value, list)
        for one, other in zip(value, read, strict=True):
            check_holds(one, other)
    elif isinstance(value, float):
        assert value == float(read)  # type: ignore[arg-type]
    else:
        assert value == read


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_scenario_says_what_one_will_see(name: str) -> None:
    text = (DIRECTORY / f"{name}.yaml").read_text()
    head, body = text.split("\n\n" + name + ":", 1)
    assert all(line.startswith("#") for line in head.splitlines())
    assert "What you will see" in head
    # Every group of values names its source.
    for group in re.split(r"\n\n", body.split("\n\n", 1)[1]):
        assert re.search(r"# .*(paper|literature|ours)", group, re.IGNORECASE), group
    title = load_scenario(name).description.splitlines()[0]
    assert len(name.ljust(24)) + 2 + len(title) <= 80


def test_defaults_load(tmp_path: Path) -> None:
    path = tmp_path / "defaults.yaml"
    path.write_text(f"Defaults: {SMALL}\n")
    assert load_scenario(path) == blimp_scenario(name="Defaults")


def test_what_has_no_default_has_to_be_given(tmp_path: Path) -> None:
    path = tmp_path / "empty.yaml"
    path.write_text("Empty: {}\n")
    assert refusal(path) == f"{path}:1: vehicle: missing"
    path.write_text("Tagless:\n  vehicle: {mass: 2}\n")
    message = refusal(path)
    expected = f"{path}:2: vehicle: its tag is missing; allowed: !Blimp, !Car"
    assert message.startswith(expected)


@pytest.mark.parametrize(
    ("key", "place"),
    [
        ("plant: !CarParameters {}", "part of vehicle"),
        ("controller: {}", "vehicle.controller"),
        ("turn_limit: {}", "vehicle.turn_limit"),
        ("corrections: {}", "fidelity"),
    ],
)
def test_a_key_that_moved_is_answered_with_its_place(key: str, place: str) -> None:
    message = refusal("car-avoidance", f"{{{key}}}")
    name = key.split(":")[0]
    assert message == f"override: {name}: unknown key; it is {place} now"


def test_one_of_everything_loads(everything: Path) -> None:
    scenario = load_scenario(everything)
    drakes = yaml_load(filename=str(everything), private=True)
    check_holds(scenario, drakes["OneOfEverything"])
    assert scenario.name == "everything"
    assert scenario.vehicle.turn_limit == TurnLimit(1.25, 0.2)
    assert scenario.disturbance[0].value == [0.01]  # YAML 1.1 reads 1e-2 as text.
    assert scenario.disturbance[1].frequency == 0.5
    assert [type(signal).__name__ for signal in scenario.disturbance] == [
        "Constant",
        "Sinusoid",
        "SmoothStep",
        "BandLimitedNoise",
        "Recorded",
    ]
    defaults = blimp_scenario()
    unmentioned = [
        each.name
        for each in dataclasses.fields(Scenario)
        if getattr(scenario, each.name) == getattr(defaults, each.name)
    ]
    assert unmentioned == []


@pytest.mark.parametrize("name", SHIPPED)
def test_dump_loads_back(name: str, tmp_path: Path) -> None:
    check_round_trip(load_scenario(name), tmp_path)


def test_dump_of_one_of_everything_loads_back(everything: Path, tmp_path: Path) -> None:
    check_round_trip(load_scenario(everything), tmp_path)


def check_round_trip(scenario: Scenario, directory: Path) -> None:
    text = dump_scenario(scenario)
    path = directory / "dump.yaml"
    path.write_text(text)
    assert load_scenario(path) == scenario
    assert dump_scenario(load_scenario(path)) == text
    check_holds(scenario, yaml_load(data=text, private=True)[scenario.name])


def test_dump_takes_arrays(tmp_path: Path) -> None:
    scenario = load_scenario("car-avoidance")
    scenario.initial_state = np.array([0.0, 0.0, 0.1 + 0.2, 0.0])  # type: ignore[assignment]
    validate(scenario)
    path = tmp_path / "dump.yaml"
    path.write_text(dump_scenario(scenario))
    assert load_scenario(path).initial_state == [0.0, 0.0, 0.1 + 0.2, 0.0]


def test_dump_takes_a_matrix_of_weights(tmp_path: Path) -> None:
    scenario = load_scenario("car-avoidance", "{input_weights: [[2, 1], [1, 3]]}")
    assert scenario.input_weights == [[2.0, 1.0], [1.0, 3.0]]
    check_round_trip(scenario, tmp_path)


def test_a_period_at_which_every_watchdog_would_bite_is_refused() -> None:
    message = refusal("car-avoidance", "{period: 0.1, hardware: {predict: true}}")
    rule = "hardware.command_timeout: 0.1; it must be above the control period, 0.1 s"
    assert message.endswith(rule)


def test_one_scenario_of_several(tmp_path: Path) -> None:
    path = tmp_path / "two.yaml"
    path.write_text(f"one: {{}}\ntwo: {SMALL[:-1]}, period: 0.05}}\n")
    assert load_scenario(path, scenario_name="two").period == 0.05
    assert "scenario_name (--scenario-name) is None; allowed: one, two" in refusal(path)
    assert "did you mean two?" in refusal(path, scenario_name="tow")


# Overrides -------------------------------------------------------------------------


def test_overrides_merge_mappings_and_replace_the_rest() -> None:
    base = load_scenario("blimp-single-obstacle")
    scenario = load_scenario(
        "blimp-single-obstacle",
        "{method: cbf-qp, vehicle: {mass: 0.2}, target: [2, 0, 1],"
        " disturbance: [!Constant {value: [0, 0, 1]}]}",
    )
    assert (scenario.method, scenario.target) == ("cbf-qp", [2.0, 0.0, 1.0])
    assert scenario.vehicle == dataclasses.replace(base.vehicle, mass=0.2)
    assert len(scenario.disturbance) == 1
    assert scenario.obstacles == base.obstacles


def test_a_key_with_dots_reaches_into_mappings_and_lists() -> None:
    dotted = "{vehicle.mass: 0.2, vehicle.added_mass.1: 0.3, volume.threshold: 0.1}"
    nested = "{vehicle: {mass: 0.2, added_mass: {1: 0.3}}, volume: {threshold: 0.1}}"
    name = "blimp-single-obstacle"
    assert load_scenario(name, dotted) == load_scenario(name, nested)
    assert load_scenario(name, {"vehicle.mass": 0.2}).vehicle.mass == 0.2  # type: ignore[attr-defined]


def test_overriding_tag_replaces() -> None:
    scenario = load_scenario("blimp-single-obstacle", "{vehicle: !Blimp {mass: 0.2}}")
    assert scenario.vehicle == BlimpVehicle(mass=0.2)


def test_overrides_as_mapping_say_the_same() -> None:
    text = "{observer: {alpha: 3.5}, disturbance: [!Constant {value: [0, 0, 1]}]}"
    mapping = {
        "observer": {"alpha": 3.5},
        "disturbance": [{"_tag": "!Constant", "value": [0, 0, 1]}],
    }
    name = "blimp-single-obstacle"
    assert load_scenario(name, text) == load_scenario(name, mapping)


def test_merged_overrides_are_one_line_that_says_the_same(everything: Path) -> None:
    expected = load_scenario(everything)
    lines = dump_scenario(expected).splitlines()[1:]
    body = "\n".join(line.removeprefix("  ") for line in lines)
    description = "description: |\n  two\n  lines\n"
    numbers = {"observer": {"alpha": 0.1 + 0.2}, "arrival_tolerance": 1e-6}
    text = merge_overrides(body, description, numbers)
    assert "\n" not in text
    expected.description = "two\nlines\n"
    expected.observer.alpha, expected.arrival_tolerance = 0.1 + 0.2, 1e-6
    merged = load_scenario("blimp-multiple-obstacles", text)
    assert dump_scenario(merged) == dump_scenario(expected)


def test_merged_overrides_keep_how_values_are_written() -> None:
    assert merge_overrides("{}") == "{}"
    text = merge_overrides("{name: '5'}", "{duration: 1e1, observer: {beta: null}}")
    assert text == "{name: '5', duration: 1e1, observer: {beta: null}}"


def test_override_can_rename() -> None:
    assert load_scenario("car-avoidance", "{name: mine}").name == "mine"


def test_messages_name_the_source_of_the_value() -> None:
    message = refusal("blimp-single-obstacle", "{period: -1}")
    assert message == "override: period: -1; it must be finite and above 0"
    # The override moves the sphere; what is wrong then is the file's start.
    message = refusal(
        "blimp-single-obstacle", {"obstacles": [{"center": [0, 0, 0.2], "radius": 0.3}]}
    )
    assert re.search(r"blimp-single-obstacle\.yaml:\d+: initial_state: ", message)
    assert "signed distance is -0.1 m" in message


# What is refused -------------------------------------------------------------------

REFUSED = [
    # Keys, tags and types.
    ("{mehtod: cbf-qp}", "mehtod", "unknown key; did you mean method?"),
    ("{observer: {alhpa: 1}}", "observer.alhpa", "did you mean alpha?"),
    (
        "{obstacles: [{center: [2, 2, 2], radius: 0.1}, {radus: 1}]}",
        "obstacles[1].radus",
        "did you mean radius?",
    ),
    (
        "{disturbance: [!Sinusoid {amplitudes: [1, 1, 1]}]}",
        "disturbance[0].amplitudes",
        "did you mean amplitude?",
    ),
    ("{vehicle: {colour: 1}}", "vehicle.colour", "allowed: mass, added_mass, drag"),
    (
        "{disturbance: [{frequency: 1}]}",
        "disturbance[0].frequency",
        "read as !Constant; or !Sinusoid, !SmoothStep",
    ),
    ("{disturbance: [!Sinus {}]}", "disturbance[0]", "did you mean !Sinusoid"),
    ("{vehicle: !Boat {}}", "vehicle", "allowed: !Blimp, !Car"),
    (
        "{observer: !Rise {}}",
        "observer",
        "unknown tag !Rise; allowed: !ObserverSettings",
    ),
    ("{period: !Seconds 1}", "period", "unknown tag !Seconds; allowed: none"),
    ("{obstacles: [{radius: 0.1}]}", "obstacles[0].center", "missing"),
    ("{obstacles: [{center: [2, 2, 2]}]}", "obstacles[0].radius", "missing"),
    ("{disturbance: [!Constant {}]}", "disturbance[0].value", "a list of finite"),
    ("{duration: long}", "duration", "'long'; it must be a number"),
    (
        "{target: [1, 90deg, 3]}",
        "target[1]",
        "'90deg'; it must be a number, unquoted and decimal",
    ),
    ("{target: [1, pi/2, 3]}", "target[1]", "decimal: 1.5708 for 90 degrees"),
    ("{target: [1, 90 °, 3]}", "target[1]", "decimal: 1.5708 for 90 degrees"),
    ("{duration: 010}", "duration", "'010'; it must be a number, unquoted and decimal"),
    (
        "{duration: 1:30}",
        "duration",
        "'1:30'; it must be a number, unquoted and decimal",
    ),
    (
        "{noise: {seed: -007}}",
        "noise.seed",
        "'-007'; it must be a whole number, unquoted",
    ),
    ("{duration: '3'}", "duration", "'3'; it must be a number"),
    ("{duration: yes}", "duration", "'yes'; it must be a number"),
    ("{duration: [3]}", "duration", "a sequence; it must be a number"),
    ("{duration: }", "duration", "None; it must be a number"),
    ("{noise: {seed: '3'}}", "noise.seed", "'3'; it must be a whole number"),
    ("{noise: {seed: 1.5}}", "noise.seed", "1.5; it must be a whole number"),
    ("{method: 3}", "method", "3; it must be text"),
    ("{target: 3}", "target", "3; it must be a list of numbers"),
    ("{noise: {std: 3.5}}", "noise.std", "3.5; it must be a list of numbers"),
    ("{disturbance: 3}", "disturbance", "3; it must be a list"),
    ("{obstacles: }", "obstacles", "None; it must be a list"),
    (
        "{obstacles: {center: [1]}}",
        "obstacles.center",
        "center; it must be an entry of the list, 0 to 0",
    ),
    ("{observer: [1]}", "observer", "a sequence; it must be a mapping"),
    ("{obstacles: [3]}", "obstacles[0]", "3; it must be a mapping"),
    ("{target: [1, [2], 3]}", "target[1]", "a sequence; it must be a number"),
    ("{period: 1, period: 2}", "period", "given twice"),
    # Numbers.
    ("{duration: .nan}", "duration", "nan; it must be finite"),
    ("{duration: .inf}", "duration", "inf; it must be finite"),
    ("{duration: 1e999}", "duration", "inf; it must be finite"),
    ("{target: [.nan, 0, 0]}", "target[0]", "nan; it must be finite"),
    ("{input_set: {upper: [.nan, 1, 1]}}", "input_set.upper[0]", "must be a number"),
    ("{input_set: {lower: [.inf, 0, 0]}}", "input_set.lower[0]", "below infinity"),
    ("{input_set: {upper: [1, -.inf, 1]}}", "input_set.upper[1]", "above minus inf"),
    (
        "{input_set: {upper: [.inf, 1, 1]}}",
        "input_set",
        "finite for the volume barrier of dob-vcbf-qp; dob-cbf-qp has none",
    ),
    (
        "{method: cbf-qp, input_set: {upper: [.inf, 1, 1], A: [[0, 1, 0]], b: [1]}}",
        "input_set",
        "is unbounded",
    ),
    ("{vehicle: {mass: .nan}}", "vehicle.mass", "finite and above 0"),
    ("{vehicle: {drag: [-1, 0, 0]}}", "vehicle.drag[0]", "not below 0"),
    (
        "{vehicle: {controller: {yaw_gain: -1}}}",
        "vehicle.controller.yaw_gain",
        "not below 0",
    ),
    ("{duration: 0}", "duration", "0; it must be finite and above 0"),
    ("{period: -0.01}", "period", "-0.01; it must be finite and above 0"),
    ("{arrival_tolerance: 0}", "arrival_tolerance", "above 0"),
    ("{observer: {beta: -6}}", "observer.beta", "-6; it must be finite and above 0"),
    ("{integrator: {max_step: -1}}", "integrator.max_step", "not below 0"),
    ("{noise: {seed: -1}}", "noise.seed", "not below 0"),
    ("{volume: {gain: 0}}", "volume.gain", "must be finite and above 0"),
    ("{volume: {threshold: 1}}", "volume.threshold", "1; it must be below 1"),
    ("{barrier: {gains: [-1, 1]}}", "barrier.gains[0]", "above 0"),
    ("{barrier: {gains: [2, 1.1]}}", "barrier.gains", "k2 <= k1^2 / 4"),
    (
        "{obstacles: [{center: [2, 2, 2], radius: -0.1}]}",
        "obstacles[0].radius",
        "-0.1; it must be finite and not below 0",
    ),
    (
        "{obstacles: [{center: [2, 2, 2], radius: 0.1, margin: -1}]}",
        "obstacles[0].margin",
        "not below 0",
    ),
    (
        "{disturbance: [!SmoothStep {amplitude: [1, 1, 1], duration: 0}]}",
        "disturbance[0].duration",
        "above 0",
    ),
    # Sizes.
    ("{initial_state: [0, 0]}", "initial_state", "8 numbers, one each of x, y, z, yaw"),
    ("{target: [1, 0]}", "target", "3 numbers, one each of x, y, z"),
    ("{obstacles: [{center: [1, 0], radius: 1}]}", "obstacles[0].center", "3 numbers"),
    (
        "{obstacles: [{center: [2, 2, 2], radius: 1, velocity: [1]}]}",
        "obstacles[0].velocity",
        "3 numbers",
    ),
    ("{noise: {std: [1]}}", "noise.std", "8 numbers, one each of x, y, z, yaw"),
    ("{input_set: {lower: [-1]}}", "input_set", "1 numbers in lower and 3 in upper"),
    ("{input_set: {A: [[1, 1]], b: [1]}}", "input_set.A[0]", "3 numbers"),
    ("{input_set: {A: [[1, 1, 1]]}}", "input_set.b", "list of 1 number"),
    ("{barrier: {gains: [1, 2, 3]}}", "barrier.gains", "real and negative roots"),
    ("{barrier: {gains: []}}", "barrier.gains", "[]; it must be [k1] or [k1, k2]"),
    (
        "{faults: {gusts: [!Step {}]}}",
        "faults.gusts[0]",
        "!Step; did you mean !StepGust?",
    ),
    ("{observer.alfa: 1}", "observer.alfa", "did you mean alpha?"),
    ("{initial_state.9: 1}", "initial_state.9", "an entry of the list, 0 to 7"),
    ("{a.b: 1, a: {b: 2}}", "a", "given twice"),
    ("{vehicle.mass: 1, vehicle: !Blimp {}}", "vehicle", "given twice"),
    ("{disturbance: [!Constant {value: [1]}]}", "disturbance[0]", "must have 3"),
    ("{vehicle: {added_mass: [1]}}", "vehicle.added_mass", "list of 3 numbers"),
    # Choices.
    ("{method: dob}", "method", "'dob'; it must be one of cbf-qp, robust-cbf-qp"),
    ("{fidelity: exact}", "fidelity", "one of corrected, paper"),
    ("{infeasible: go}", "infeasible", "one of stop, least_violation, hold, decay"),
    ("{between_ticks: always}", "between_ticks", "one of none, certified"),
    ("{observer: {step: euler}}", "observer.step", "implicit, saturated, explicit"),
    ("{barrier: {form: cube}}", "barrier.form", "one of distance, squared"),
    ("{integrator: {scheme: rk4}}", "integrator.scheme", "runge_kutta3"),
    # Units and sizes that people mix up.
    ("{initial_state: [0, 0, 0, 90, 0, 0, 0, 0]}", "initial_state[3]", "degrees"),
    ("{duration: 1e9}", "duration", "at most 100000 s, 1e+07 ticks of 0.01 s"),
    # Parts that must agree.
    (
        "{between_ticks: certified, fidelity: paper}",
        "between_ticks",
        "must be none without the correction error_floor",
    ),
    (
        "{input_set: {lower: [0, 0, 1]}}",
        "input_set.lower[2]",
        "at most upper, 0.0145525",
    ),
    ("{input_set: {A: [[1, 0, 0]], b: [-9]}}", "input_set", "is empty"),
    ("{period: 30}", "period", "at most the duration, 20 s"),
    (
        "{period: 0.05, hardware: {max_state_age: 0.05}}",
        "hardware.max_state_age",
        "above the control period, 0.05 s",
    ),
    (
        "{observer: {period: 1}}",
        "observer.period",
        "at most the control period, 0.01 s",
    ),
    ("{observer: {period: -1}}", "observer.period", "not below 0"),
    (
        "{vehicle: {controller: !CarControllerParameters {}}}",
        "vehicle.controller",
        "unknown tag !CarControllerParameters; did you mean !Blimp",
    ),
    ("{vehicle: {turn_limit: {}}}", "vehicle.turn_limit", "unknown key; allowed"),
    ("{target: [0.5, 0.1, 0.5]}", "target", "signed distance is -0.1 m"),
    (
        "{disturbance: [!Recorded {times: [0, 1, 2],"
        " values: [[0, 0, 0], [0, 0, 0], [0, 0, 0]]}]}",
        "disturbance[0].times",
        "must span",
    ),
]


@pytest.mark.parametrize(("override", "key", "allowed"), REFUSED)
def test_refuses(override: str, key: str, allowed: str) -> None:
    message = refusal("blimp-single-obstacle", override)
    assert message.startswith(f"override: {key}: ")
    assert allowed in message


@pytest.mark.parametrize(
    ("line", "replacement", "key"),
    [
        (
            "      approach_gain: 0.5",
            "      aproach_gain: 0.5",
            "vehicle.controller.aproach_gain",
        ),
        ("    upper: [2.0, 1.0]", "    upper: [2.0, one]", "input_set.upper[1]"),
        ("    b: [1.5]", "    b: [-9.0]", "input_set"),
        ("    - !Constant {value: [1e-2]}", "    - !Const {}", "disturbance[0]"),
        ("      radius: 0.3", "      radius: -0.3", "obstacles[0].radius"),
        ("    gains: [4.0, 4.0]", "    gains: [4.0, 4.1]", "barrier.gains"),
        ("  method: vcbf-qp", "  method: cbf", "method"),
        ("  target: [5.0, 0.0]", "  target: [5.0]", "target"),
        ("  period: 0.05", "  period: 60.0", "period"),
        ("    std: [0.0, 0.0, 0.01, 0.0]", "    std: [0.1]", "noise.std"),
    ],
)
def test_names_file_and_line(
    everything: Path, line: str, replacement: str, key: str
) -> None:
    lines = ONE_OF_EVERYTHING.splitlines()
    number = lines.index(line)
    lines[number] = replacement
    everything.write_text("\n".join(lines))
    # What a whole mapping is blamed for is located at its key.
    expected = lines.index(f"  {key}:") if f"  {key}:" in lines else number
    assert refusal(everything).startswith(f"{everything}:{expected + 1}: {key}: ")


def test_names_line_of_syntax_error(tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text("one:\n  target: [1, 2\n  period: 1\n")
    assert refusal(path).startswith(f"{path}:3: not YAML: ")


def test_missing_file_suggests_shipped_names() -> None:
    message = refusal("blimp-single-obstacles")
    assert message.startswith("blimp-single-obstacles: neither a file nor")
    assert all(name in message for name in SHIPPED)
    assert "did you mean blimp-single-obstacle" in message
    # Each name once, whether one of them is near or not.
    assert all(message.count(f" {name}") <= 2 for name in SHIPPED)
    assert all(refusal("nope").count(name) == 1 for name in SHIPPED)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "nothing; it must be a mapping"),
        (b"- 1\n", "a sequence; it must be a mapping"),
        (b"_only: {}\n", "holds no scenario"),
        (b"one:\n", "nothing; it must be a mapping"),
        (b"\xff\xfe\xfa", "not a UTF-8 text file"),
        (b"one: {}\n---\ntwo: {}\n", "not YAML"),
        (b"one: \x07\n", "not YAML"),
        (b"one: *nowhere\n", "not YAML"),
        (b"? [1]\n: 2\n", "a sequence; a key must be a word"),
        (b"one: {<<: 3}\n", "<<: a scalar; it must be a mapping"),
    ],
)
def test_refuses_file(tmp_path: Path, content: bytes, problem: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_bytes(content)
    message = refusal(path)
    assert message.startswith(str(path))
    assert problem in message


def test_a_forgotten_name_is_named(tmp_path: Path) -> None:
    path = tmp_path / "nameless.yaml"
    path.write_text("vehicle: !Car {mass: 2}\nduration: 3\n")
    message = refusal(path)
    assert "vehicle at the top; a scenario's name is missing above it" in message


def test_a_long_path_is_shown_whole() -> None:
    file = "/".join(["directory"] * 12)
    with pytest.raises(InvalidValueError, match=file):
        require(False, "file", file, "a file")


def test_refuses_directory(tmp_path: Path) -> None:
    assert refusal(tmp_path).startswith(f"{tmp_path}: ")


def test_an_override_that_is_no_mapping_is_answered_with_one() -> None:
    message = refusal("car-avoidance", "duration=5")
    assert message == "override: a scalar; it must be a mapping, such as {duration: 5}"


def test_files_of_an_override_are_relative_to_the_working_directory(
    everything: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    scenario = load_scenario(everything, "{hardware: {key_file: key}}")
    assert scenario.hardware.key_file == str(here / "key")


def test_refuses_overrides_yaml_cannot_hold() -> None:
    assert refusal("car-avoidance", {"noise": {"std": object()}}).startswith("override")


def test_garbled_scenarios_load_or_are_refused_in_one_line(everything: Path) -> None:
    """Whatever is written over a token, nothing but a `ScenarioError` escapes."""
    generator = random.Random(5)
    junk = ["", "{}", "[]", "~", "-1", "!Tag x", "'", "[[1]]", ".nan", "&a *a", "text"]
    tokens = list(re.finditer(r"[\w.!-]+", ONE_OF_EVERYTHING))
    refused = 0
    for _ in range(300):
        token = generator.choice(tokens)
        everything.write_text(
            ONE_OF_EVERYTHING[: token.start()]
            + generator.choice(junk)
            + ONE_OF_EVERYTHING[token.end() :]
        )
        try:
            load_scenario(everything)
        except ScenarioError as error:
            assert str(error).startswith(str(everything))
            assert "\n" not in str(error)
            refused += 1
    assert refused > 200


# Scenarios made in Python ----------------------------------------------------------


def test_validate_names_the_field() -> None:
    scenario = blimp_scenario(obstacles=[SphereObstacle([3.0, 3.0, 3.0], 0.5)])
    validate(scenario)
    scenario.obstacles[0].radius = float("nan")
    with pytest.raises(InvalidValueError, match="nan; it must be finite") as caught:
        validate(scenario)
    assert caught.value.path == ("obstacles", 0, "radius")
    scenario.obstacles.clear()
    scenario.volume.gain = -1.0
    with pytest.raises(InvalidValueError, match="-1; it must be"):
        validate(scenario)


@pytest.mark.parametrize(
    ("center", "radius", "margin", "velocity", "allowed"),
    [
        ([0.0, 0.0, 0.5], 0.4, 0.0, [], True),
        ([0.0, 0.0, 0.5], 0.4, 0.2, [], False),
        ([0.0, 0.0, 0.5], 0.5, 0.0, [], False),
        ([1.0, 0.0, 1.0], 0.1, 0.0, [], False),
        # A moving obstacle may pass over the target.
        ([1.0, 0.0, 1.0], 0.1, 0.0, [1.0, 0.0, 0.0], True),
        ([0.0, 0.0, 0.0], 0.1, 0.0, [1.0, 0.0, 0.0], False),
    ],
)
def test_start_and_target_are_outside(
    center: list[float],
    radius: float,
    margin: float,
    velocity: list[float],
    allowed: bool,
) -> None:
    obstacles = [SphereObstacle(center, radius, velocity, margin)]
    if allowed:
        validate(blimp_scenario(obstacles=obstacles))
    else:
        with pytest.raises(InvalidValueError, match="outside obstacles"):
            blimp_scenario(obstacles=obstacles)


@pytest.mark.parametrize(
    ("gains", "allowed"),
    [([4.0, 4.0], True), ([4.0, 4.001], False), ([3.0, 2.0], True)],
)
def test_gains_have_real_negative_roots(gains: list[float], allowed: bool) -> None:
    scenario = blimp_scenario()
    scenario.barrier.gains = gains
    if allowed:
        validate(scenario)
        assert np.all(np.roots([1.0, *gains]) < 0.0)
    else:
        with pytest.raises(InvalidValueError, match=r"k2 <= k1\^2 / 4"):
            validate(scenario)


def test_limits_may_be_infinite_where_no_volume_is_asked(tmp_path: Path) -> None:
    limits = "{lower: [-.inf, -0.2, -0.02], upper: [0.25, .inf, 0.02]}"
    scenario = load_scenario(
        "blimp-single-obstacle", f"{{method: dob-cbf-qp, input_set: {limits}}}"
    )
    check_round_trip(scenario, tmp_path)
    inputs = scenario.input_set.input_set()
    assert not inputs.is_bounded
    assert inputs.contains([-1e9, 1e9, 0.0])
    assert not inputs.contains([0.3, 0.0, 0.0])
    assert not inputs.contains([0.0, -0.3, 0.0])


def test_rows_may_bound_what_infinite_limits_leave_open() -> None:
    limits = "{lower: [0, 0, 0], upper: [.inf, .inf, 1], A: [[1, 2, 0]], b: [4]}"
    scenario = load_scenario("blimp-single-obstacle", f"{{input_set: {limits}}}")
    inputs = scenario.input_set.input_set()
    assert inputs.is_bounded
    assert inputs.contains([3.9, 0.0, 0.5])
    assert not inputs.contains([0.0, 2.1, 0.5])


@pytest.mark.parametrize("method", ["cbf-qp", "dob-vcbf-qp"])
def test_equal_limits_are_a_dead_actuator(method: str) -> None:
    limits = "{lower: [-0.25, -0.2, 0.01], upper: [0.25, 0.2, 0.01]}"
    scenario = load_scenario(
        "blimp-single-obstacle",
        f"{{method: {method}, duration: 0.2, input_set: {limits}}}",
    )
    result = simulate(scenario)
    applied = result.log["input"]
    assert (applied[1:, 2] == 0.01).all()
    assert applied[:, :2].any()


def test_input_set_holds_box_and_rows() -> None:
    limits = copy.deepcopy(blimp_scenario().input_set)
    limits.lower, limits.upper = [-1.0, -1.0, -1.0], [1.0, 2.0, 3.0]
    assert limits.input_set().is_box
    limits.A, limits.b = [[1.0, 1.0, 0.0]], [0.5]
    inputs = limits.input_set()
    for u in np.random.default_rng(0).uniform(-3.5, 3.5, (200, 3)):
        inside = (
            np.all((limits.lower <= u) & (u <= limits.upper)) and u[0] + u[1] <= 0.5
        )
        assert inputs.contains(u) == inside
