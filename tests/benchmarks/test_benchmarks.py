"""The benchmark's problem, its answers, its peers, and the ticks that it measures."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
import quadprog

from tests.benchmarks import problem, reference
from tests.benchmarks.routes import TASKS, Cost, markdown, measure, safety_filter
from tests.benchmarks.ticks import (
    STAGES,
    filter_among_balls,
    growth_markdown,
    point_mass,
    tick_context,
    tick_times,
)
from vcbf_drake.safety import FilterStatus, inscribed_ellipsoid

INSTANCES = problem.instances(40)


# The problem and its answers ---------------------------------------------------------


def test_rows_by_hand_are_the_rows_derived() -> None:
    rows = safety_filter("cbf-qp").barrier_set.rows
    for instance in INSTANCES:
        derived = rows(instance.state, 0.0)
        A, b = problem.barrier_rows(instance.state)
        np.testing.assert_allclose(derived.A, A, rtol=1e-12)
        np.testing.assert_allclose(derived.b, b, rtol=1e-12, atol=1e-12)


def test_some_instances_are_infeasible_and_in_the_others_the_rows_matter() -> None:
    found = [reference.ellipsoid_gradient(each.state) for each in INSTANCES]
    assert 1 <= sum(each is None for each in found) <= 20
    assert all(each is None or np.linalg.norm(each[1]) > 1e-6 for each in found)


def test_the_nearest_input_is_quadprogs() -> None:
    empty = 0
    for each in INSTANCES:
        A, b = problem.polytope(each.state)
        found = reference.nearest_input(A, b, each.reference)
        try:
            expected = quadprog.solve_qp(np.eye(3), each.reference, -A.T, -b)[0]
        except ValueError:
            assert found is None
            empty += 1
        else:
            np.testing.assert_allclose(found, expected, atol=1e-9)
    assert empty


def test_the_ellipsoid_is_the_certified_one() -> None:
    for each in INSTANCES:
        found = reference.ellipsoid_gradient(each.state)
        if found is not None:
            certified = inscribed_ellipsoid(*problem.polytope(each.state))
            assert np.log(found[0]) == pytest.approx(certified.log_det, abs=1e-8)


def test_the_gradient_is_that_of_the_volume() -> None:
    """Richardson's differences; they fail where another row begins to touch."""
    checked = 0
    for each in INSTANCES[:20]:
        found = reference.ellipsoid_gradient(each.state)
        if found is None:
            continue
        move = 1e-3 * found[1] / np.linalg.norm(found[1])

        def det(size: float, state: Any = each.state, move: Any = move) -> float:
            along = reference.ellipsoid_gradient(state + size * move)
            return np.nan if along is None else along[0]

        coarse, fine = det(2.0) - det(-2.0), det(1.0) - det(-1.0)
        slope = (8.0 * fine - coarse) / (12.0 * 1e-3)
        if slope == pytest.approx(np.linalg.norm(found[1]), rel=1e-5):
            checked += 1
    assert checked >= 12


# Routes ------------------------------------------------------------------------------


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.title)
def test_every_route_that_is_installed_solves_the_task(task: Any) -> None:
    ours, *others = measure(task, INSTANCES[:20])
    assert isinstance(ours, Cost)
    assert ours.worst < 1e-7
    assert ours.failed == 0 and ours.noticed == ours.infeasible > 0
    for peer in others:
        # SCS is that inexact, and cbfpy's solver leaves its rows by as much.
        assert isinstance(peer, str) or (peer.failed == 0 and peer.worst < 0.1)


def test_drakes_differences_are_about_right() -> None:
    """So that what we compare with is not a straw man."""
    for task, largest in zip(TASKS[1:], (1e-3, 1e-5), strict=True):
        peer = list(measure(task, INSTANCES[:8]))[1]
        assert isinstance(peer, Cost) and peer.name == "Drake, differences"
        assert peer.worst < largest


def test_who_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("cbfpy", "cvxpy", "jax"):
        monkeypatch.setitem(sys.modules, name, None)
    costs = list(measure(TASKS[0], INSTANCES[:3]))
    assert [cost for cost in costs if isinstance(cost, str)] == [
        "cbfpy",
        "cvxpy, rows by hand",
    ]
    table = list(markdown(TASKS[0], costs))
    assert any(line.startswith("| cbfpy | not installed |") for line in table)
    assert len({line.count("|") for line in table if line.startswith("|")}) == 1


# Ticks -------------------------------------------------------------------------------


def test_every_stage_of_a_volume_tick_takes_time() -> None:
    times = tick_times(ticks=5)
    assert tuple(times) == STAGES
    assert all(0.0 < median <= p99 for median, p99 in times.values())
    assert tick_times(method="dob-cbf-qp", ticks=3)["volume"] == (0.0, 0.0)


@pytest.mark.parametrize(("count", "cutting"), [(4, 0), (4, 1), (5, 5)])
@pytest.mark.parametrize("m", [1, 3])
def test_as_many_obstacles_cut_as_asked_for(m: int, count: int, cutting: int) -> None:
    system = filter_among_balls(m, count, cutting, None, 2 * m + 1, "cbf-qp")
    feasible = system.feasible_set(tick_context(system, np.zeros(2 * m + 1)))
    assert len(feasible.cut) == cutting
    assert np.all(feasible.rows.value > 0.0)


@pytest.mark.parametrize(
    ("method", "room", "status"),
    [
        ("dob-vcbf-qp", 0.003, FilterStatus.RELAXED),
        ("dob-vcbf-qp", -0.05, FilterStatus.INFEASIBLE),
        ("dob-cbf-qp", -0.05, FilterStatus.INFEASIBLE),
    ],
)
def test_ticks_between_two_obstacles_are_what_they_are_called(
    method: str, room: float, status: FilterStatus
) -> None:
    system = filter_among_balls(3, 3, 2, room, 6, method)
    for jitter in 1e-3 * np.random.default_rng(2).normal(size=(10, 3)):
        context = tick_context(system, np.append(jitter, np.zeros(3)))
        assert system.decision(context).status == status
        feasible = system.feasible_set(context)
        opposite = feasible.distance[:2] / np.linalg.norm(feasible.normals[:2], axis=1)
        assert opposite.sum() == pytest.approx(2.0 * room, abs=1e-4)


def test_the_point_mass_moves_as_it_says() -> None:
    model = point_mass(2, 5)
    x = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    assert np.allclose(model.drift(x), [3.0, 4.0, 0.2, 0.1, -5.0])
    assert np.array_equal(model.input_matrix(x), model.disturbance_matrix)


def test_a_table_of_growth_has_a_line_a_setting() -> None:
    title, *lines = growth_markdown("method", ticks=2)
    assert title.startswith("### method")
    assert len(lines) == 2 + 6
    assert len({line.count("|") for line in lines}) == 1
