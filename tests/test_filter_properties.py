"""Whatever comes in, what leaves the filter is finite and inside the input limits."""

from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np

from vcbf_drake.barriers import BarrierRows
from vcbf_drake.safety import (
    DisturbanceKnowledge,
    FilterStatus,
    InputSet,
)
from vcbf_drake.safety.feasible_set import feasible_set
from vcbf_drake.safety.filter_qp import INFEASIBLE_POLICIES, VolumeRow, choose_input

BOX = InputSet.box([-1.0, -0.2, -3.0], [0.5, 0.3, 1.0])
TRIANGLE = InputSet(
    [[1.0, 1.0, 0.0], [-1.0, 0.5, 0.0], [0.2, -1.0, 0.0], [0, 0, 1.0], [0, 0, -1.0]],
    [1.0, 1.0, 0.5, 2.0, 1.0],
)

numbers = st.one_of(
    st.floats(-2.0, 2.0),
    st.floats(-1e-9, 1e-9),
    st.floats(-1e9, 1e9),
    st.sampled_from([0.0, np.nan, np.inf, -np.inf]),
)
tame = st.one_of(st.floats(-2.0, 2.0), st.sampled_from([0.0, 1.0, -1.0]))


@st.composite
def situations(draw, entries):
    n = draw(st.integers(0, 5))
    A, b = (
        draw(arrays(float, (n, 3), elements=entries)),
        draw(arrays(float, n, elements=entries)),
    )
    if n > 1 and draw(st.booleans()):  # A row given twice, in other units.
        A[1], b[1] = 7.0 * A[0], 7.0 * b[0]
    rows = BarrierRows(
        value=np.ones(n),
        chain=tuple(np.ones(2) for _ in range(n)),
        A=A,
        b=b,
        w=np.zeros((n, 1)),
        num_states=2,
        gradients=lambda rows: np.zeros((len(rows), 3 + 2, 3)),
    )
    row = None
    if draw(st.booleans()):
        a = draw(arrays(float, 3, elements=tame))
        row = VolumeRow(a, draw(st.floats(-5.0, 5.0)), 1e3)
    reference = draw(arrays(float, 3, elements=entries))
    held = draw(arrays(float, 3, elements=entries))
    return rows, row, reference, held


def decide(situation, input_set, exact_slack, policy, *more_volume_rows):
    rows, row, reference, held = situation
    volume_rows = [*([] if row is None else [row]), *more_volume_rows]
    with np.errstate(over="ignore", invalid="ignore"):
        feasible = feasible_set(input_set, rows, DisturbanceKnowledge.constant(1, 0.0))
        decision = choose_input(
            feasible,
            volume_rows,
            reference,
            held,
            input_set,
            exact_slack,
            policy,
        )
    return feasible, decision


@settings(max_examples=1000, deadline=None, derandomize=True)
@given(
    situations(numbers),
    st.sampled_from([BOX, TRIANGLE]),
    st.booleans(),
    st.sampled_from(INFEASIBLE_POLICIES),
)
def test_nothing_illegal_leaves(situation, input_set, exact_slack, policy):
    _, decision = decide(situation, input_set, exact_slack, policy)
    assert np.isfinite(decision.input).all()
    assert input_set.contains(decision.input)
    assert decision.slack <= 0.0
    finite = all(np.isfinite(x).all() for x in (situation[0].A, situation[0].b))
    if not (finite and np.isfinite(situation[2]).all()):
        assert decision.status == FilterStatus.FAILED


@settings(max_examples=1000, deadline=None, derandomize=True)
@given(situations(tame), st.sampled_from([BOX, TRIANGLE]))
def test_the_status_is_true(situation, input_set):
    feasible, decision = decide(situation, input_set, True, "least_violation")
    assert decision.status != FilterStatus.FAILED
    v = (decision.input - input_set.center) / input_set.scale
    # A row that no input can move (R33) is reported as such, not kept to its own size.
    length = np.maximum(np.linalg.norm(feasible.A_v, axis=1), 1e-6)
    violation = np.max((feasible.A_v @ v - feasible.b_v) / length)
    if decision.status == FilterStatus.INFEASIBLE:
        assert violation > 0.0
        assert 1 <= len(decision.conflict) <= 4
    else:
        assert violation <= 1e-7
    if decision.status == FilterStatus.REFERENCE:
        assert np.array_equal(decision.input, situation[2])


halves = st.integers(-4, 4).map(lambda i: i / 2.0)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(situations(halves), arrays(float, 3, elements=halves), st.floats(-5.0, 5.0))
def test_a_second_volume_row_takes_nothing_from_the_first(situation, a, c):
    _, alone = decide(situation, BOX, True, "stop")
    second = VolumeRow(a, c, 1e3)
    _, both = decide(situation, BOX, True, "stop", second)
    if situation[1] is None or alone.status == FilterStatus.INFEASIBLE:
        return
    assert both.status != FilterStatus.FAILED
    first = situation[1]
    assert first.a @ both.input - first.c <= -alone.slack + 1e-6
