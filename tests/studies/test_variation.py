"""Variations: random values for any field, written in YAML or in Python."""

import json
import pickle

import numpy as np
import pytest
from scipy import stats

from vcbf_drake.errors import ScenarioError
from vcbf_drake.simulation.loading import load_scenario
from vcbf_drake.studies import PythonVariation, Trial, Variation, load_variation

CAR, BLIMP = "car-avoidance", "blimp-multiple-obstacles"


def draws(text, count=300, scenario=CAR):
    base = load_scenario(scenario)
    return [Variation(text).draw(base, 0, index) for index in range(count)]


@pytest.mark.parametrize(
    ("text", "read", "distribution"),
    [
        (
            "observer.alpha: !Uniform [4.6, 6.0]",
            lambda draw: draw["observer"]["alpha"],
            stats.uniform(4.6, 1.4),
        ),
        (
            "initial_state.1: !Add [-0.1, 0.3]",
            lambda draw: draw["initial_state"][1],
            stats.uniform(load_scenario(CAR).initial_state[1] - 0.1, 0.4),
        ),
        (
            "{vehicle: {controller: {approach_gain: !Scale [0.5, 2.0]}}}",
            lambda draw: draw["vehicle"]["controller"]["approach_gain"],
            stats.uniform(
                0.5 * load_scenario(CAR).vehicle.controller.approach_gain,
                1.5 * load_scenario(CAR).vehicle.controller.approach_gain,
            ),
        ),
        (
            "volume.threshold: !Normal [0.02, 0.005]",
            lambda draw: draw["volume"]["threshold"],
            stats.norm(0.02, 0.005),
        ),
    ],
)
def test_values_have_the_distribution_that_was_written(text, read, distribution):
    sample = [read(draw) for draw in draws(text)]
    assert stats.kstest(sample, distribution.cdf).pvalue > 0.01


def test_numbers_are_written_as_in_a_scenario():
    (draw,) = draws("observer: {alpha: !Uniform [6e0, 6e0], eps: 1.0e-3, a: yes}", 1)
    assert draw["observer"] == {"alpha": 6.0, "eps": 0.001, "a": "yes"}


def test_a_choice_takes_every_value_and_no_other():
    chosen = {d["method"] for d in draws("method: !Choice [cbf-qp, dob-cbf-qp]", 40)}
    assert chosen == {"cbf-qp", "dob-cbf-qp"}


def test_entries_of_a_list_are_drawn_and_the_others_stay():
    base = load_scenario(CAR)
    (draw,) = draws("{initial_state: {0: !Add [1.0, 1.0]}}", 1)
    expected = np.array(base.initial_state) + np.eye(4)[0]
    assert draw["initial_state"] == pytest.approx(expected)


def test_an_entry_of_a_list_that_the_file_leaves_out_is_drawn():
    variation = Variation("separation.gains.0: !Scale [1.1, 1.1]")
    scenario = Trial(CAR, "cbf-qp", 0, variation=variation).load()
    assert scenario.separation.gains == pytest.approx([11.0, 3.55])


def test_a_draw_hangs_on_seed_and_index_alone_and_travels():
    variation = Variation("observer.alpha: !Uniform [4.6, 6.0]")
    base = load_scenario(CAR)
    again = pickle.loads(pickle.dumps(variation))
    assert again.draw(base, 1, 2) == variation.draw(base, 1, 2)
    assert (
        len({json.dumps(variation.draw(base, s, i)) for s in (0, 1) for i in (0, 1)})
        == 4
    )


def test_the_name_is_the_text_on_one_line():
    text = "observer.alpha: !Uniform [4.6, 6.0]\nperiod: 0.05\n"
    assert Variation(text).name == "{observer.alpha: !Uniform [4.6, 6.0], period: 0.05}"
    assert Variation(text, "gains").name == "gains"
    assert (
        Variation().name == "none" and Variation().draw(load_scenario(CAR), 0, 0) == {}
    )


def test_obstacles_with_tags_of_their_own_load():
    text = "{disturbance: [!Constant {value: [!Uniform [0.1, 0.1]]}]}"
    scenario = Trial(CAR, "cbf-qp", 0, variation=Variation(text)).load()
    assert scenario.disturbance[0].value == [0.1]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (
            "observer.alpha: !Uniform [6.0, 4.6]",
            "variation:1: !Uniform goes from 6 down to 4.6",
        ),
        (
            "a: 1\nb: !Uniform [1]",
            "variation:2: !Uniform takes a list of two finite numbers",
        ),
        ("a: !Add [.inf, 1]", "!Add takes a list of two finite numbers"),
        ("a: !Normal [0, -1]", "standard deviation -1, below 0"),
        ("a: !Choice []", "!Choice takes a list of values"),
        ("a: !Gauss [0, 1]", "!Gauss is no distribution; allowed: !Uniform"),
        (
            "[1, 2]",
            "a sequence; it must be a mapping, such as {observer",
        ),
        ("a: !Uniform [[1], 2]", "!Uniform takes a list of two finite numbers"),
        ("a: !Uniform [1, 010]", "!Uniform takes a list of two finite numbers"),
        ("a: 1\na: 2", "variation:2: a: given twice"),
        ("a.b: 1\na: {b: 2}", "variation:2: a: given twice"),
        ("a: 1\na.b: 2", "variation:2: a.b: given twice"),
        ("a: [1]\na.b.c: 2", "variation:2: a.b: b; it must be an entry of the list"),
        ("a: [", "not YAML"),
        ("nope.yaml", "nope.yaml: No such file"),
        ("nope.py", "nope.py: No such file"),
    ],
)
def test_a_text_that_is_no_variation_is_refused_in_a_line(text, problem):
    with pytest.raises(ScenarioError) as refused:
        load_variation(text)
    assert problem in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("initial_state.9: !Add [0, 1]", "initial_state.9: entries are 0 to 3"),
        ("description: !Scale [0, 1]", "description: !Scale needs a number"),
        ("nothing: !Add [0, 1]", "nothing: !Add needs a number"),
        ("vehicle.controller: !Scale [0, 1]", "the section of turn_gain, speed_gain"),
    ],
)
def test_what_the_scenario_does_not_have_is_refused(text, problem):
    with pytest.raises(ScenarioError, match=problem):
        Variation(text).draw(load_scenario(CAR), 0, 0)


def test_a_field_without_a_number_is_told_of_uniform():
    base = load_scenario(CAR, {"arrival_tolerance": None})
    with pytest.raises(ScenarioError, match="None there, so take !Uniform"):
        Variation("arrival_tolerance: !Scale [0, 1]").draw(base, 0, 0)


def test_a_file_is_read_and_a_python_file_computes(tmp_path):
    yaml_file, python_file = tmp_path / "vary.yaml", tmp_path / "vary.py"
    yaml_file.write_text("observer.alpha: !Uniform [5.0, 5.0]\n")
    python_file.write_text(
        "def draw(scenario, generator):\n"
        "    return {'duration': scenario.duration + float(generator.integers(5))}\n"
    )
    base = load_scenario(CAR)
    drawn = load_variation(str(yaml_file)).draw(base, 0, 0)
    assert drawn == {"observer": {"alpha": 5.0}}
    computed = load_variation(str(python_file))
    assert isinstance(computed, PythonVariation)
    again = pickle.loads(pickle.dumps(computed))
    assert again.draw(base, 0, 1) == computed.draw(base, 0, 1)
    name = computed.name
    python_file.write_text(python_file.read_text() + "# changed\n")
    assert computed.name != name
    python_file.with_name("empty.py").write_text("")
    with pytest.raises(ScenarioError, match=r"draw\(\): None; it must be a function"):
        load_variation(str(tmp_path / "empty.py"))
