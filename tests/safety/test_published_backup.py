"""Method backup on the double integrator of van Wijk et al. (2024), by another route.

D. van Wijk, S. Coogan, T. Molnar, M. Majji, K. Hobbs, "Disturbance-Robust Backup
Control Barrier Functions", IEEE Control Systems Letters, 2024, with their public code
(github.com/davidvwijk/DR-bCBF, double_integrator): x1' = x2, x2' = u, |u| <= 1,
h = -x1, the backup u_b = -1 for 1.5 s, at every 0.02 s of it a row with
alpha(h) = 15 h + h^3 of h less 0.01 |(2, 1)|, at its end one of -x2 with 10; the start
(-1.5, 0), the wish u = 1, steps of 0.02 s for 5 s. Here SciPy integrates the flow,
differences give its sensitivity, and with one input the QP is the least of its bounds.
"""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.helpers.braking_integrator import braking_integrator
from vcbf_drake.barriers import Barrier
from vcbf_drake.safety import FilterSettings, FilterStatus, InputSet, SafetyFilter

STEP, HORIZON, STEPS = 0.02, 1.5, 251
MARGIN = 0.5 * STEP * math.hypot(2.0, 1.0)
START, WISH = (-1.5, 0.0), 1.0
DISTURBANCE = 0.08 / math.sqrt(2.0) * np.ones(2)


def alpha(h):
    return 15.0 * h + h**3


@pytest.fixture(scope="module")
def chosen():
    """Returns our filter: of a state the input, and whether its rows leave none."""
    model = braking_integrator(HORIZON)
    wall = Barrier(lambda x, t, p: -x[0], [2.0, 1.0], name="wall").with_class_k(alpha)
    safety_filter = SafetyFilter(
        model,
        [wall],
        InputSet.box([-1.0], [1.0]),
        FilterSettings(method="backup", backup_margin=MARGIN, period=STEP),
    )
    context = safety_filter.CreateDefaultContext()
    safety_filter.GetInputPort("reference").FixValue(context, [WISH])
    safety_filter.GetInputPort("estimate").FixValue(context, np.zeros(4))

    def choose(x):
        safety_filter.GetInputPort("state").FixValue(context, x)
        decision = safety_filter.decision(context)
        empty = decision.status == FilterStatus.INFEASIBLE
        return float(decision.input[0]), empty

    return choose


def flow(x, instants):
    """Returns where the backup leads, (K, 2), and its derivatives by x, (K, 2, 2)."""

    def led(start):
        rate = lambda _, y: [y[1], -1.0]  # noqa: E731
        span = (0.0, instants[-1])
        found = solve_ivp(rate, span, start, t_eval=instants, rtol=1e-9, atol=1e-9)
        return found.y.T

    step = 1e-4
    slopes = [(led(x + step * e) - led(x - step * e)) / (2 * step) for e in np.eye(2)]
    return led(x), np.stack(slopes, axis=2)


def published(x, instants):
    """Returns the input of the published rows at some instants, and whether none.

    Without one the published filter brakes fully.
    """
    states, slopes = flow(x, instants)
    drift, most = np.array([x[1], 0.0]), WISH
    for (position, _), slope in zip(states, slopes, strict=True):
        gradient = np.array([-1.0, 0.0]) @ slope
        side = gradient @ drift + alpha(-position - MARGIN)
        assert gradient[1] < 0.0  # The row bounds the input from above.
        most = min(most, side / -gradient[1])
    gradient = np.array([0.0, -1.0]) @ slopes[-1]
    most = min(most, (gradient @ drift - 10.0 * states[-1, 1]) / -gradient[1])
    return max(most, -1.0), most < -1.0


THEIRS = STEP * np.arange(1, 75)
OURS = HORIZON / 60 * np.arange(1, 61)


def run(choose, disturbance=(0.0, 0.0)):
    """Returns states and inputs of the published run."""
    x, states, inputs = np.array(START), [], []
    d = np.asarray(disturbance)
    for _ in range(STEPS):
        u, _ = choose(x)
        states.append(x)
        inputs.append(u)
        w = np.array([x[1], u]) + d
        x = x + STEP * w + 0.5 * STEP**2 * np.array([w[1], 0.0])
    return np.array(states), np.array(inputs)


@pytest.fixture(scope="module")
def ours(chosen):
    return run(chosen)


def test_every_input_of_the_published_run_by_another_route(chosen, ours):
    states, inputs = ours
    empty = 0
    for x, u in zip(states[::5], inputs[::5], strict=True):
        expected, is_empty = published(x, OURS)
        assert u == pytest.approx(expected, abs=2e-6)
        assert chosen(x)[1] == is_empty
        empty += is_empty
    # The published margin is just about what alpha asks for: 1 / (2 * 15^2) more.
    assert 0 < empty < 20


def test_the_published_run(ours):
    """Safe, at full thrust as long as that is, and then along the safe set's edge."""
    states, inputs = ours
    theirs, their_inputs = run(lambda x: published(x, THEIRS))
    np.testing.assert_allclose(states, theirs, atol=0.01)
    for found in (inputs, their_inputs):
        assert (found[:50] == pytest.approx(WISH)) and found.min() > -1.0 - 1e-9
    # The set that full braking keeps: x1 + x2^2 / 2 <= 0 while x2 > 0.
    kept = states[:, 0] + 0.5 * np.maximum(states[:, 1], 0.0) ** 2
    assert kept.max() < 0.0 and states[-1, 0] > -0.05
    assert kept[len(kept) // 3 :].min() > -0.1


def test_a_disturbance_that_the_rows_do_not_know_breaks_it(chosen):
    """As published: the plain backup barrier leaves the safe set in a steady wind."""
    states, _ = run(chosen, DISTURBANCE)
    assert states[:, 0].max() > 0.0
