"""Whatever comes in, what leaves the filter is what it says it is.

The checker shares no code with the filter: see `vcbf_drake.studies.decision_check`. The
same instances, in greater numbers, are run by `vcbf-drake reliability`.
"""

from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest

from vcbf_drake.safety import FilterStatus, InputSet
from vcbf_drake.safety.filter_qp import INFEASIBLE_POLICIES, VolumeRow
from vcbf_drake.studies.decision_check import UNSOLVED, Tick, broken_promises
from vcbf_drake.studies.property_campaign import ALL_KINDS, decide, make_example

BOX = InputSet.box([-1.0, -0.2, -3.0], [0.5, 0.3, 1.0])
TRIANGLE = InputSet(
    [[1.0, 1.0, 0.0], [-1.0, 0.5, 0.0], [0.2, -1.0, 0.0], [0, 0, 1.0], [0, 0, -1.0]],
    [1.0, 1.0, 0.5, 2.0, 1.0],
)


def nothing_tinier(number):
    """Rows of next to nothing are a kind of hostile ticks, of no floats between."""
    return 0.0 if abs(number) < 1e-12 else number


numbers = st.one_of(
    st.floats(-2.0, 2.0).map(nothing_tinier),
    st.floats(-1e-9, 1e-9).map(nothing_tinier),
    st.floats(-1e9, 1e9).map(nothing_tinier),
    st.sampled_from([0.0, np.nan, np.inf, -np.inf]),
)
tame = st.one_of(
    st.floats(-2.0, 2.0).map(nothing_tinier), st.sampled_from([0.0, 1.0, -1.0])
)
halves = st.integers(-4, 4).map(lambda i: i / 2.0)


@st.composite
def ticks(draw, entries, input_sets=(BOX, TRIANGLE)):
    n = draw(st.integers(0, 5))
    A = draw(arrays(float, (n, 3), elements=entries))
    b = draw(arrays(float, n, elements=entries))
    if n > 1 and draw(st.booleans()):  # A row given twice, in other units.
        A[1], b[1] = 7.0 * A[0], 7.0 * b[0]
    volume_rows = []
    if draw(st.booleans()):
        a = draw(arrays(float, 3, elements=halves))
        volume_rows = [VolumeRow(a, draw(st.floats(-5.0, 5.0)), 1e3)]
    return Tick(
        input_set=draw(st.sampled_from(input_sets)),
        A=A,
        b=b,
        weights=np.ones(n),
        volume_rows=volume_rows,
        reference=draw(arrays(float, 3, elements=entries)),
        held_input=draw(arrays(float, 3, elements=entries)),
        exact_slack=draw(st.booleans()),
        policy=draw(st.sampled_from(INFEASIBLE_POLICIES)),
    )


@settings(max_examples=4000, deadline=None, derandomize=True)
@given(ticks(numbers))
def test_nothing_illegal_leaves(tick):
    decision = decide(tick)
    assert np.isfinite(decision.input).all()
    assert tick.input_set.contains(decision.input)
    assert decision.slack <= 0.0
    if not tick.is_finite:
        assert decision.status == FilterStatus.FAILED
    assert set(broken_promises(tick, decision)) <= {UNSOLVED}


@settings(max_examples=4000, deadline=None, derandomize=True)
@given(ticks(tame))
def test_every_promise_is_kept(tick):
    assert broken_promises(tick, decide(tick)) == ()


@settings(max_examples=1000, deadline=None, derandomize=True)
@given(ticks(halves, [BOX]), arrays(float, 3, elements=halves), st.floats(-5.0, 5.0))
def test_a_second_volume_row_takes_nothing_from_the_first(tick, a, c):
    if not tick.volume_rows or not tick.exact_slack:
        return
    alone = decide(tick)
    tick.volume_rows.append(VolumeRow(a, c, 1e3))
    both = decide(tick)
    if alone.status == FilterStatus.INFEASIBLE:
        return
    assert both.status != FilterStatus.FAILED
    first = tick.volume_rows[0]
    assert first.a @ both.input - first.c <= -alone.slack + 1e-6


@settings(max_examples=12_000, deadline=None, derandomize=True)
@given(st.sampled_from(range(len(ALL_KINDS))), st.integers(0, 2**40))
def test_every_promise_is_kept_on_hostile_ticks(kind, number):
    example = make_example(1, kind + number * len(ALL_KINDS))
    assert example.kind == ALL_KINDS[kind]
    assert set(example.broken) <= {UNSOLVED}


# Each once broke a promise.
FOUND = ()


@pytest.mark.parametrize("number", FOUND)
def test_what_was_found(number):
    assert make_example(0, number).broken == ()
