from __future__ import annotations

import json
from pathlib import Path
import sys
from typing import Any

import numpy as np
import pytest
import quadprog
from typer.testing import CliRunner

from vcbf_drake.cli import app
from vcbf_drake.safety import inscribed_ellipsoid
from vcbf_drake.studies.bench import measure, ours, problem, reference, run_bench
from vcbf_drake.studies.bench.tasks import OURS, TASKS
from vcbf_drake.viz.bench_figure import write_bench

INSTANCES = problem.instances(40)


@pytest.fixture(scope="module")
def results() -> dict[str, Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measure, "_QUICK", (8, 0.1))
        # As if nobody else were installed.
        for name in ("cbfpy", "cvxpy", "cvxpylayers", "jax"):
            patch.setitem(sys.modules, name, None)
        return run_bench(quick=True)


# The problem and its answers ---------------------------------------------------------


def test_rows_by_hand_are_the_rows_derived() -> None:
    rows = ours.safety_filter("cbf-qp").barrier_set.rows
    for instance in INSTANCES:
        derived = rows(instance.state, 0.0)
        A, b = problem.barrier_rows(instance.state)
        np.testing.assert_allclose(derived.A, A, rtol=1e-12)
        np.testing.assert_allclose(derived.b, b, rtol=1e-12, atol=1e-12)


def test_instances_are_repeatable_and_not_all_feasible() -> None:
    again = problem.instances(40)
    assert all(
        (one.state == two.state).all()
        for one, two in zip(INSTANCES, again, strict=True)
    )
    found = [reference.ellipsoid_gradient(each.state) for each in INSTANCES]
    assert 1 <= sum(each is None for each in found) <= 20
    # Everywhere else the rows matter.
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


# Results -----------------------------------------------------------------------------


def test_ours_is_right(results: dict[str, Any]) -> None:
    for task in results["tasks"]:
        own = task["routes"][0]
        assert own["name"] == OURS and own["ratio"] == 1.0
        assert own["error_max"] < 1e-7
        assert own.get("failed", 0) == 0
        assert own.get("noticed") == own.get("infeasible")


def test_the_solvers_alone_find_what_the_whole_tick_finds(
    results: dict[str, Any],
) -> None:
    alone = results["tasks"][2]["routes"][-1]
    assert alone["name"] == "ours: ellipsoid, QP alone"
    assert alone["error_max"] < 1e-7
    assert alone["failed"] == 0 and alone["noticed"] == alone["infeasible"]


def test_drakes_differences_are_about_right(results: dict[str, Any]) -> None:
    """So that what we compare with is not a straw man."""
    gradient, tick, run = results["tasks"][1:]
    for task, largest in ((gradient, 1e-3), (tick, 1e-5), (run, 1e-5)):
        peer = task["routes"][1]
        assert peer["name"] == "Drake, differences"
        assert peer["error_max"] < largest
        assert peer.get("failed", 0) == 0


def test_the_missing_are_named(results: dict[str, Any]) -> None:
    missing = [task["missing"] for task in results["tasks"]]
    assert missing == [["cbfpy", "cvxpy"], *[["cvxpylayers"]] * 3]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "route"),
    [(task, route) for task in TASKS for route in task.routes[1:]],
    ids=lambda each: each.name,
)
def test_every_peer_that_is_installed_solves_the_task(task: Any, route: Any) -> None:
    try:
        function = route.make()
    except ImportError:
        pytest.skip(f"{route.package} is not installed")
    errors = []
    for each in INSTANCES[:20]:
        arguments = task.arguments(each)
        if hasattr(function, "prepare"):
            arguments = function.prepare(*arguments)
        right, found = task.answer(each), function(*arguments)
        if right is not None and found is not None:
            errors.append(task.error(found, right))
    assert len(errors) >= 10
    assert np.median(errors) < 1e-3


def test_results_are_plain_and_their_picture_repeatable(
    results: dict[str, Any], tmp_path: Path
) -> None:
    again = json.loads(json.dumps(results, allow_nan=False))
    assert again == results
    contents = []
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        paths = write_bench(again, tmp_path / name)
        assert [path.name for path in paths] == ["bench.png", "bench.svg"]
        contents.append([path.read_bytes() for path in paths])
    assert contents[0] == contents[1]


def test_the_command_writes_and_prints(
    results: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool] = []

    def stand_in(quick: bool, progress: Any) -> dict[str, Any]:
        asked.append(quick)
        progress(0.5)
        return results

    monkeypatch.setattr("vcbf_drake.studies.bench.run_bench", stand_in)
    out = tmp_path / "out"
    shown = CliRunner().invoke(app, ["bench", "--quick", "--out", str(out)])
    assert shown.exit_code == 0, shown.output
    assert asked == [True]
    names = {path.name for path in out.iterdir()}
    assert names == {"bench.json", "bench.png", "bench.svg"}
    assert json.loads((out / "bench.json").read_text()) == results
    lines = shown.output.splitlines()
    assert max(len(line.rstrip()) for line in lines if "written" not in line) <= 80
    assert "pip install 'vcbf-drake[bench]'" in shown.output
