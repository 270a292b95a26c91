"""The stages of a tick: they are measured on the ticks that were asked for."""

import numpy as np
import pytest

from vcbf_drake.safety import FilterStatus, InputSet, SafetyFilter
from vcbf_drake.studies import tick_times as module
from vcbf_drake.studies.tick_times import STAGES, point_mass, tick_times


def test_every_stage_of_a_volume_tick_takes_time():
    times = tick_times(num_obstacles=3, num_cutting=2, ticks=5)
    assert tuple(times) == STAGES
    for stage in ("rows", "ellipsoid", "QP", "tick"):
        assert 0.0 < times[stage]["median"] <= times[stage]["p99"]


def test_a_plain_filter_has_no_ellipsoid():
    times = tick_times(method="dob-cbf-qp", ticks=3)
    assert times["ellipsoid"] == times["volume"] == {"median": 0.0, "p99": 0.0}


@pytest.mark.parametrize(("count", "cutting"), [(4, 0), (4, 1), (5, 5)])
@pytest.mark.parametrize("m", [1, 3])
def test_as_many_obstacles_cut_as_asked_for(m, count, cutting):
    generator = np.random.default_rng(1)
    balls = module._balls(m, count, cutting, generator)
    box = InputSet.box(-np.ones(m), np.ones(m))
    safety_filter = SafetyFilter(point_mass(m, 2 * m + 1), balls, box, method="cbf-qp")
    context = module._context(safety_filter, np.zeros(2 * m + 1))
    assert len(safety_filter.feasible_set(context).cutting) == 2 * m + cutting
    distance = safety_filter.feasible_set(context).rows
    assert np.all(distance.value > 0.0)


@pytest.mark.parametrize(
    ("method", "room", "status"),
    [
        ("dob-vcbf-qp", 0.003, FilterStatus.RELAXED),
        ("dob-vcbf-qp", -0.05, FilterStatus.INFEASIBLE),
        ("dob-cbf-qp", -0.05, FilterStatus.INFEASIBLE),
    ],
)
def test_ticks_between_two_obstacles_are_what_they_are_called(method, room, status):
    balls = module._balls(3, 3, 2, np.random.default_rng(0), room)
    box = InputSet.box(-np.ones(3), np.ones(3))
    safety_filter = SafetyFilter(point_mass(3, 6), balls, box, method=method)
    for jitter in np.random.default_rng(2).normal(size=(10, 3)):
        state = np.concatenate([module._JITTER * jitter, np.zeros(3)])
        context = module._context(safety_filter, state)
        assert safety_filter.decision(context).status == status
        feasible = safety_filter.feasible_set(context)
        opposite = feasible.b_v[6:8] / np.linalg.norm(feasible.A_v[6:8], axis=1)
        assert opposite.sum() == pytest.approx(2.0 * room, abs=1e-4)
    assert tick_times(method=method, room=room, ticks=2)["tick"]["median"] > 0.0


def test_the_point_mass_moves_as_it_says():
    model = point_mass(2, 5)
    x = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    assert np.allclose(model.drift(x), [3.0, 4.0, 0.2, 0.1, -5.0])
    assert np.array_equal(model.input_matrix(x), model.disturbance_matrix)


@pytest.mark.parametrize(
    "settings", [{"num_states": 5}, {"num_obstacles": 2, "num_cutting": 3}]
)
def test_impossible_settings_are_refused(settings):
    with pytest.raises(ValueError, match="2 states an input"):
        tick_times(**settings)


@pytest.mark.parametrize("settings", [{"room": 1.5}, {"room": 0.1, "num_cutting": 1}])
def test_impossible_room_is_refused(settings):
    with pytest.raises(ValueError, match="at most 1, and between two"):
        tick_times(**settings)
