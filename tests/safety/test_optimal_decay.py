"""Optimal decay against the example of its authors, and in a whole loop.

The example is the adaptive cruise control of Zeng, Zhang, Li and Sreenath, "Safety-
critical control using optimal-decay control barrier function with guaranteed point-wise
feasibility" (ACC 2021), with the constants of their published program.
"""

import numpy as np
from pydrake.systems.framework import LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem
import pytest
from scipy.optimize import minimize_scalar

from vcbf_drake import (
    Barrier,
    FilterSettings,
    FilterStatus,
    InputSet,
    SafetyFilter,
    load_scenario,
    simulate,
)
from vcbf_drake.errors import InvalidValueError
from vcbf_drake.model import ControlAffineModel

MASS, F0, F1, F2 = 1650.0, 0.1, 5.0, 0.25
DESIRED, AHEAD, HEADWAY = 30.0, 16.0, 1.8  # [m/s], [m/s], [s]
ALPHA, GAMMA, CLF_PENALTY, DECAY_PENALTY = 0.5, 1.0, 1.0, 1e8
MOST = 0.25 * MASS * 9.81  # [N]
STEP, DURATION, DISTANCE = 0.01, 12.0, 100.0


def resistance(v):
    return F0 + F1 * v + F2 * v * v


@TemplateSystem.define("Follower_")
def Follower_(T):
    class Impl(LeafSystem_[T]):
        def _construct(self, converter=None):
            LeafSystem_[T].__init__(self, converter=converter)
            self._force = self.DeclareVectorInputPort("force", 1)
            self.DeclareStateOutputPort("state", self.DeclareContinuousState(2))

        def _construct_copy(self, other, converter=None):
            Impl._construct(self, converter=converter)

        def DoCalcTimeDerivatives(self, context, derivatives):
            v, _ = context.get_continuous_state_vector().CopyToVector()
            (force,) = self._force.Eval(context)
            rates = [(force - resistance(v)) / MASS, AHEAD - v]
            derivatives.get_mutable_vector().SetFromVector(np.array(rates))

    return Impl


def our_filter(method):
    """Their CLF is a soft barrier, their costs are weights and penalties."""
    safety_filter = SafetyFilter(
        ControlAffineModel.from_system(Follower_[None]()),
        [
            Barrier(lambda x, t, p: -((x[0] - DESIRED) ** 2), [GAMMA], name="speed"),
            Barrier(lambda x, t, p: x[1] - HEADWAY * x[0], [ALPHA], name="headway"),
        ],
        InputSet.box([-MOST], [MOST]),
        FilterSettings(
            period=STEP,
            method=method,
            input_weights=[1.0 / MASS**2],
            soft_penalties=[CLF_PENALTY, np.inf],
            decay_penalty=DECAY_PENALTY,
        ),
    )
    context = safety_filter.CreateDefaultContext()
    port = safety_filter.GetInputPort("estimate")
    port.FixValue(context, np.zeros(port.size()))
    safety_filter.GetInputPort("held_input").FixValue(context, [0.0])
    return safety_filter, context


def our_input(made, v, z):
    safety_filter, context = made
    safety_filter.GetInputPort("state").FixValue(context, [v, z])
    safety_filter.GetInputPort("reference").FixValue(context, [resistance(v)])
    return safety_filter.decision(context)


def their_input(v, z, is_variable):
    """Min (u - F_r)^2/m^2 + p s^2 + p_w (w - 1)^2 over the force alone; None if empty.

    s and w are the least that a force needs: what is left is convex in one variable.
    """
    h, drag = z - HEADWAY * v, resistance(v)

    def cost(u):
        clf = 2.0 * (v - DESIRED) * (u - drag) / MASS + GAMMA * (v - DESIRED) ** 2
        # h' >= -w alpha h.
        rate = AHEAD - v - HEADWAY * (u - drag) / MASS
        growth = max(0.0, (-rate - ALPHA * h) / (ALPHA * h))
        return (
            ((u - drag) / MASS) ** 2
            + CLF_PENALTY * max(0.0, clf) ** 2
            + DECAY_PENALTY * growth**2 * is_variable
        )

    hardest = drag + MASS * (AHEAD - v + ALPHA * h) / HEADWAY
    most = MOST if is_variable else min(MOST, hardest)
    if most < -MOST:
        return None
    return minimize_scalar(
        cost, bounds=(-MOST, most), method="bounded", options={"xatol": 1e-9}
    ).x


def drive(v, choose):
    """Takes their Euler steps: when no input was left, the last v and the least h."""
    z, heights = DISTANCE, []
    for tick in range(round(DURATION / STEP)):
        u = choose(v, z)
        if u is None:
            return tick * STEP, v, min(heights)
        v, z = v + STEP * (u - resistance(v)) / MASS, z + STEP * (AHEAD - v)
        heights.append(z - HEADWAY * v)
    return None, v, min(heights)


@pytest.mark.parametrize(
    ("method", "start", "is_lost"),
    [
        ("dob-cbf-qp", 28.0, False),
        ("dob-cbf-qp", 30.0, True),
        ("dob-cbf-qp", 32.0, True),
        ("optimal-decay", 28.0, False),
        ("optimal-decay", 30.0, False),
        ("optimal-decay", 32.0, False),
    ],
)
def test_the_authors_adaptive_cruise_control(method, start, is_lost):
    """With their fixed rate the fast starts are lost, with a variable one none is."""
    made, decays = our_filter(method), method == "optimal-decay"

    def ours(v, z):
        decision = our_input(made, v, z)
        lost = decision.status >= FilterStatus.INFEASIBLE
        return None if lost else float(decision.input[0])

    lost_at, v, least = drive(start, ours)
    assert (lost_at is not None) == is_lost
    theirs = drive(start, lambda v, z: their_input(v, z, decays))
    assert theirs == pytest.approx((lost_at, v, least), abs=2e-3)
    assert least > 0.0
    if decays:
        assert v == pytest.approx(AHEAD, abs=0.5)


def test_single_ticks_of_the_example():
    made = our_filter("optimal-decay")
    for v, z in [(32.0, 70.0), (30.0, 62.0), (25.0, 47.0), (18.0, 33.0), (20.0, 90.0)]:
        decision = our_input(made, v, z)
        expected = their_input(v, z, True)
        np.testing.assert_allclose(decision.input, [expected], atol=1e-3 * MOST)
        rate = AHEAD - v - HEADWAY * (expected - resistance(v)) / MASS
        omega = max(1.0, -rate / (ALPHA * (z - HEADWAY * v)))
        assert decision.decay == pytest.approx(omega, abs=2e-3)


def test_a_car_that_runs_out_of_inputs_arrives():
    result = simulate(load_scenario("car-sensitivity", {"method": "optimal-decay"}))
    assert result.summary["outcome"] == "reached"
    assert result.summary["infeasible_at"] is None
    assert result.summary["decayed_ticks"] > 10
    for name in ("row", "barrier", "chain", "barrier between ticks"):
        assert result.summary["audit"][name]["held"]


def test_no_certificate_between_ticks_for_rates_that_a_tick_chooses():
    with pytest.raises(InvalidValueError, match="between_ticks: 'certified'; it must"):
        FilterSettings(method="optimal-decay", between_ticks="certified")
    with pytest.raises(InvalidValueError, match="decay_penalty: 0"):
        FilterSettings(decay_penalty=0.0)
