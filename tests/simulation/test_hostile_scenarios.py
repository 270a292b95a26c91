"""Hostile scenario files: one printable line, in good time, and nothing executed."""

import re

import pytest

from vcbf_drake import ScenarioError, load_scenario
from vcbf_drake.simulation.loading import dump_scenario, parse_scenario

SMALL = """\
s:
  vehicle: !Car {}
  input_set: {lower: [-1, -1], upper: [1, 1]}
  initial_state: [0, 0, 0, 0]
  target: [3, 0]
"""
LAUGHS = "a: &a0 [x, x]\n" + "".join(
    f"_{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 9)
)
MERGED_LAUGHS = "a: &a0 {x: 1}\n" + "".join(
    f"_{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}\n" for i in range(1, 12)
)


def complaint(text, overrides=None):
    with pytest.raises(ScenarioError) as error:
        parse_scenario(text, "hostile.yaml", overrides)
    line = str(error.value)
    assert line.isprintable()
    assert len(line) < 400
    return line


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("s: " + "[" * 10_000, "nested too deeply"),
        ("s: " + "{a: " * 3000 + "1" + "}" * 3000, "nested too deeply"),
        ("s: &a [*a]", "a sequence; it must be a mapping"),
        ("s: 3", "hostile.yaml:1: 3; it must be a mapping"),
        ("s: &a {obstacles: [*a]}", "obstacles.0..name: unknown key"),
        ("s: &a {<<: *a}", "vehicle: missing"),
        (LAUGHS, "a sequence; it must be a mapping"),
        (MERGED_LAUGHS, "<<: a sequence; it must be a mapping"),
        ('s: !!python/object/apply:os.system ["exit"]', "a sequence; it must be"),
        ("s: !!python/name:os.system {duration: x}", "'x'; it must be a number"),
        ("s: \x00", "not YAML"),
        ('"s\\e[2J": {plant: 1}\n"\\n": 3', r"holds 2 scenarios.*s\\x1b\[2J,"),
    ],
    ids=lambda value: value[:12],
)
def test_files(text, expected):
    assert re.search(expected, complaint(text))


SIGNAL = "{{disturbance: [!{}]}}"


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (
            SIGNAL.format("BandLimitedNoise {std: [1], tones: 1000000000}"),
            "tones: 1000",
        ),
        (
            SIGNAL.format("BandLimitedNoise {std: [1], seed: 1" + 400 * "0" + "}"),
            "seed: 10",
        ),
        (
            SIGNAL.format(
                "Recorded {times: [-1e308, 0, 1e308], values: [[1], [2], [3]]}"
            ),
            r"times\[0\]: -1e\+308",
        ),
        (
            SIGNAL.format("Recorded {times: [0, 1e-320, 99], values: [[1], [2], [3]]}"),
            "increasing, by at least 1e-09 s",
        ),
        ("{noise: {seed: 1" + 400 * "0" + "}}", "noise.seed: 10.*1e\\+15 in size"),
        (
            "{noise: {seed: " + 5000 * "9" + "}}",
            "noise.seed: '9999.*it must be a whole number",
        ),
        ("{barrier: {gains: [1e308, 1]}}", r"gains\[0\]: 1e\+308"),
        (
            "{hardware: {predict: !!bool maybe}}",
            "predict: 'maybe'; it must be true or false",
        ),
        ("{duration: 1, period: 1e-300}", "period: 1e-300; it must be at least 1e-07"),
        ("{faults: {measurement_delay: 1e9}}", "measurement_delay: 1e\\+09"),
        ('{name: "../../outside"}', "name: '../../outside'"),
        ("{name: /outside}", "name: '/outside'"),
        ("{name: ..}", "name: '..'"),
        ('{volume: {"measure\\n\\n": 1}}', r"volume.measure\\n\\n: unknown key"),
    ],
    ids=lambda value: value[:40],
)
def test_overrides(overrides, expected):
    assert re.search(expected, complaint(SMALL, overrides))


def test_a_mapping_that_is_merged_gives_what_is_not_given():
    text = "{duration: 9, <<: {duration: 3, period: 0.05}}"
    scenario = load_scenario("car-avoidance", text)
    assert (scenario.duration, scenario.period) == (9.0, 0.05)


def test_several_mappings_that_are_merged_are_refused():
    """PyYAML's versions differ in which of them wins."""
    expected = "override: <<: a sequence; it must be a mapping"
    assert complaint(SMALL, "{<<: [{duration: 3}, {duration: 4}]}") == expected


def test_a_merged_mapping_may_be_used_twice():
    text = "_base: &base {gain: 2.0}\n_v: &v {<<: *base, gain: 3.0}\n" + SMALL
    text += "  volume: *v\n"
    scenario = parse_scenario(text + "_again: *v\n", "twice.yaml")
    assert scenario.volume.gain == 3.0


@pytest.mark.parametrize("value", ["010", "1:30", "1_000", "0x10", "1e", "."])
def test_numbers_in_other_notations_are_refused(value):
    expected = "override: duration: " + repr(value)
    assert complaint(SMALL, f"{{duration: {value}}}").startswith(expected)


@pytest.mark.parametrize(
    ("value", "number"),
    [("1e1", 10.0), (".5e1", 5.0), ("+5", 5.0), ("5.", 5.0), ("1.0E+1", 10.0)],
)
def test_numbers_are_those_of_yaml_1_2(value, number):
    assert load_scenario("car-avoidance", f"{{duration: {value}}}").duration == number


@pytest.mark.parametrize("name", ["1e3", "010", "5", "yes", "null", "0x1"])
def test_a_text_that_looks_like_something_else_is_dumped_as_text(name):
    scenario = load_scenario("car-avoidance", {"name": name, "description": name})
    again = parse_scenario(dump_scenario(scenario), "dump.yaml")
    assert (again.name, again.description) == (name, name)
