"""A tick's programs: who answers, and what another of Drake's solvers makes of them."""

from collections import Counter
import logging

import numpy as np
from pydrake.solvers import (
    ClarabelSolver,
    OsqpSolver,
    ScsSolver,
    SnoptSolver,
    SolverOptions,
)
import pytest

from vcbf_drake import load_scenario, simulate
from vcbf_drake.barriers import SphereObstacle
from vcbf_drake.model import ControlAffineModel
from vcbf_drake.plants import Blimp
from vcbf_drake.safety import (
    FilterSettings,
    FilterStatus,
    InputSet,
    SafetyFilter,
    VolumeBarrier,
    decision,
)
from vcbf_drake.safety.programs import (
    EllipsoidProgram,
    FixedProgram,
    NearestPointProgram,
)
from vcbf_drake.safety.volume import VolumeMeasure

LIMITS = InputSet.box([-0.05, -0.2, -0.02], [0.25, 0.2, 0.02])


def random_ticks(count, **settings):
    """Filters' contexts among two obstacles, of which some cut the inputs."""
    model = ControlAffineModel.from_system(Blimp())
    barriers = [
        SphereObstacle([1.0, 0.1, 0.1], 0.5).barrier([4.0, 3.0], name="near"),
        SphereObstacle([0.9, -0.7, 0.2], 0.4).barrier([4.0, 3.0], name="beside"),
    ]
    safety_filter = SafetyFilter(
        model, barriers, LIMITS, FilterSettings(method="vcbf-qp", **settings)
    )
    rng = np.random.default_rng(3)
    for _ in range(count):
        context = safety_filter.CreateDefaultContext()
        state = rng.normal(0.0, [0.1] * 3 + [0.3] + [0.2] * 4)
        safety_filter.GetInputPort("state").FixValue(context, state)
        reference = LIMITS.center + 2.0 * LIMITS.scale * rng.uniform(-1.0, 1.0, 3)
        safety_filter.GetInputPort("reference").FixValue(context, reference)
        yield safety_filter, context


def tight(solver):
    options = SolverOptions()
    if solver in (OsqpSolver, ScsSolver):
        for name in ("eps_abs", "eps_rel"):
            options.SetOption(solver.id(), name, 1e-9)
    return options


def test_every_answer_is_a_solved_programs(monkeypatch, capsys):
    """In Test 2 of the paper: the reference passes, or a solver was asked."""
    solved = Counter()

    def counted(kind, made_exact):
        def solve(self, *data):
            found = made_exact(self, *data)
            solved[kind] += found is not None
            return found

        return solve

    for kind in (NearestPointProgram, EllipsoidProgram):
        monkeypatch.setattr(kind, "solve", counted(kind, kind.solve))
    cut = Counter()
    chosen, largest = decision.choose_input, VolumeMeasure.largest

    def choose(*arguments):
        before = solved[NearestPointProgram]
        decision = chosen(*arguments)
        if decision.status != FilterStatus.REFERENCE:
            cut["ticks"] += 1
            cut["by a QP"] += solved[NearestPointProgram] > before
        return decision

    def solve(self, A, b):
        before = solved[EllipsoidProgram]
        found = largest(self, A, b)
        # A box that no row cuts, or one alone, has a closed form.
        if found.log_det != 0.0 and (b < np.abs(A).sum(axis=1)).sum() > 1:
            cut["ellipsoids"] += 1
            cut["by a cone program"] += solved[EllipsoidProgram] > before
        return found

    monkeypatch.setattr("vcbf_drake.safety.safety_filter.choose_input", choose)
    monkeypatch.setattr(VolumeMeasure, "largest", solve)
    scenario = load_scenario("blimp-multiple-obstacles", {"method": "dob-vcbf-qp"})
    assert simulate(scenario).summary["outcome"] == "reached"
    with capsys.disabled():
        print(
            f"\nTest 2: {cut['ticks']} ticks whose reference did not pass,"
            f" {cut['by a QP']} answered by a QP; {cut['ellipsoids']} ellipsoids of"
            f" sets that several rows cut, {cut['by a cone program']} by a cone program"
        )
    assert cut["by a QP"] == cut["ticks"] > 500
    assert cut["by a cone program"] == cut["ellipsoids"] > 100


@pytest.mark.parametrize("solver", [OsqpSolver, SnoptSolver])
def test_another_solver_of_the_qp_has_the_filters_answer(solver):
    filtered = 0
    for safety_filter, context in random_ticks(30):
        decision = safety_filter.decision(context)
        programs = safety_filter.programs(context)
        if programs is None:
            assert decision.status == FilterStatus.INFEASIBLE
            continue
        result = solver().Solve(programs.qp, None, tight(solver))
        assert result.is_success()
        error = (programs.input(result) - decision.input) / LIMITS.scale
        np.testing.assert_allclose(error, 0.0, atol=1e-5)
        filtered += decision.status == FilterStatus.FILTERED
    assert filtered > 10


@pytest.mark.parametrize("solver", [ClarabelSolver, ScsSolver])
@pytest.mark.parametrize("widening", [1.0, 3.0])
def test_another_solver_of_the_ellipsoid_has_the_filters_volume(solver, widening):
    barrier = VolumeBarrier(widening=widening)
    compared = 0
    for safety_filter, context in random_ticks(20, volume=barrier):
        volume = safety_filter.volume(context).value + safety_filter.threshold(context)
        programs = safety_filter.programs(context)
        if programs is None or volume < 0.05:
            continue
        result = solver().Solve(programs.ellipsoid, None, tight(solver))
        assert result.is_success()
        # SCS is that inexact.
        assert np.exp(programs.log_det(result)) == pytest.approx(volume, abs=1e-3)
        compared += volume < 1.0
    assert compared > 5


def test_rows_are_named_and_the_programs_are_the_callers_own():
    names, volumes = set(), 0
    for safety_filter, context in random_ticks(20):
        programs = safety_filter.programs(context)
        if programs is None:
            continue
        binding = programs.qp.linear_constraints()[0]
        assert len(programs.qp_rows) == len(binding.evaluator().upper_bound())
        assert len(programs.ellipsoid_rows) == len(
            programs.ellipsoid.lorentz_cone_constraints()
        )
        names.update(programs.qp_rows)
        volumes += "volume" in programs.qp_rows
        again = safety_filter.programs(context)
        assert again.qp is not programs.qp
        binding.evaluator().UpdateUpperBound(np.full(len(programs.qp_rows), -1.0))
        assert safety_filter.decision(context).status != FilterStatus.FAILED
    assert {"near", "beside", "upper limit of input 0"} <= names and volumes > 0


@pytest.mark.parametrize("solver", ["NLopt", "OSQP", "SNOPT"])
def test_the_solver_is_a_choice_that_changes_no_answer(solver):
    for (a, at_a), (b, at_b) in zip(
        random_ticks(15), random_ticks(15, solver=solver), strict=True
    ):
        mine, other = a.decision(at_a), b.decision(at_b)
        assert mine.status == other.status
        np.testing.assert_allclose(mine.input, other.input, atol=1e-9)


def test_a_solver_without_a_license_is_refused_when_the_settings_are_made():
    with pytest.raises(ValueError, match=r"solver: 'Mosek'; .* no license here"):
        FilterSettings(solver="Mosek")


class OneProgram(FixedProgram):
    """The bounds |v_j| <= 1, and rows of sizes that no solver likes."""

    def __init__(self, seed: int) -> None:
        super().__init__(4, ClarabelSolver(), SolverOptions())
        random = np.random.default_rng(seed)
        A = random.normal(size=(8, 4)) * 10.0 ** random.uniform(-9, 9, (8, 1))
        b = random.normal(size=8) * 10.0 ** random.uniform(-9, 9, 8)
        cost = random.normal(size=4) * 1e6
        self.program.AddLinearConstraint(A, np.full(8, -np.inf), b, self.variables)
        self.program.AddQuadraticCost(1e6 * np.eye(4), cost, self.variables)

    def solve(self) -> None:
        self._solve()


def test_a_solver_that_gives_up_says_nothing_to_the_user(caplog):
    caplog.set_level(logging.INFO, logger="drake")
    programs = [OneProgram(seed) for seed in (25, 35, 66)]
    for each in programs:
        each.solve()
    assert not caplog.records
    for each in programs:  # The user's own programs say what they always said.
        ClarabelSolver().Solve(each.program)
    assert any("Clarabel returns" in each.message for each in caplog.records)
