"""Formulas as graphs: values and derivatives against pydrake's own, and differences."""

from __future__ import annotations

import gc
import math
import weakref

import numpy as np
from pydrake.symbolic import (
    Variable,
    abs,
    acos,
    asin,
    atan,
    atan2,
    cos,
    cosh,
    exp,
    if_then_else,
    log,
    logical_and,
    logical_not,
    logical_or,
    max,
    min,
    pow,
    sin,
    sinh,
    sqrt,
    tan,
    tanh,
)
import pytest

from vcbf_drake.model.formulas import compile_nodes, read
from vcbf_drake.model.graph import (
    ONE,
    ZERO,
    along,
    gradients,
    number,
    substitute,
    variable,
    variables_of,
)

x, y = Variable("x"), Variable("y")
A, B = variable("a"), variable("b")
NODES = {x: A, y: B}
SMOOTH = [
    x * y - 3.0 * x / (1.0 + y * y) + 0.5,
    pow(x * x + 0.3, 0.5) * pow(x * x + y * y + 1.0, 1.5),
    pow(2.0 + x * x, -0.5) - pow(1.0 + y * y, -3),
    pow(1.5 + x * x, y) + x**4 - pow(2.0, y),
    sin(x * y) + cos(x - y) - tan(0.3 * x),
    asin(0.3 * x) + acos(0.2 * y) + atan(x * y) + atan2(y, 2.0 + x * x),
    exp(-x * x) * log(2.0 + y * y) + sqrt(1.0 + x * x),
    sinh(x) - cosh(y) * tanh(x * y),
    -(x - y) * -(y + 1.0) - (-x) / (2.0 + y * y),
]
SWITCHING = [
    abs(x) * x + min(x, y) - max(2.0 * x, y),
    if_then_else(logical_and(x > y, logical_not(y >= 1.0)), x * x, 3.0 * y),
    if_then_else(logical_or(x < -0.5, y <= 0.2), x * y, x - y),
]
POINTS = np.random.default_rng(4).uniform(-1.0, 1.0, (20, 2))


def evaluate(nodes, point):
    return np.array(compile_nodes([A, B], nodes)(*point.tolist()))


@pytest.mark.parametrize("expression", [*SMOOTH, *SWITCHING])
def test_values_and_first_derivatives(expression) -> None:
    (node,) = read([expression], NODES)
    slopes = gradients([node], [A, B])[0]
    for point in POINTS:
        environment = dict(zip((x, y), point, strict=True))
        right = expression.Evaluate(environment)
        assert evaluate([node], point) == pytest.approx([right], rel=1e-13)
        step = 1e-6
        for i, slope in enumerate(evaluate(slopes, point)):
            ahead, behind = point.copy(), point.copy()
            ahead[i] += step
            behind[i] -= step
            rise = evaluate([node], ahead) - evaluate([node], behind)
            assert slope == pytest.approx(rise[0] / (2.0 * step), rel=1e-6, abs=1e-7)


@pytest.mark.parametrize("expression", SMOOTH)
def test_second_derivatives_are_pydrakes(expression) -> None:
    (node,) = read([expression], NODES)
    second = gradients(gradients([node], [A, B]).ravel(), [A, B]).ravel()
    own = [expression.Differentiate(v).Differentiate(w) for v in (x, y) for w in (x, y)]
    for point in POINTS:
        environment = dict(zip((x, y), point, strict=True))
        right = [e.Evaluate(environment) for e in own]
        assert evaluate(second, point) == pytest.approx(right, rel=1e-9, abs=1e-12)


def test_what_switches_has_no_second_derivative() -> None:
    slopes = gradients(read([abs(x)], NODES), [A])[0]
    with pytest.raises(ValueError, match="abs has no such derivative"):
        gradients(slopes, [A])


def test_equal_formulas_are_one_node() -> None:
    assert read([sin(x) * y], NODES) == read([y * sin(x)], NODES)
    assert (A + B) - B is not A  # Rounding is kept.
    assert A - A is ZERO
    assert A * 0.0 is ZERO
    assert 1.0 * A is A
    opposite = -A
    assert -opposite is A
    assert A**1.0 is A
    assert A * A is A**2.0
    assert number(2.0) + 3.0 is number(5.0)
    assert ONE / number(4.0) is number(0.25)


def test_a_division_by_zero_is_left_to_whoever_evaluates_it() -> None:
    function = compile_nodes([A], [ONE / ZERO + A])
    with pytest.raises(ZeroDivisionError):
        function(1.0)


def test_derivatives_of_what_is_shared_stay_short() -> None:
    """Pydrake's own would visit 2^40 nodes."""
    node = A
    for _ in range(40):
        node = read([sin(x)], NODES)[0] * node + 1.0 / (1.0 + node * node)
    (slope,) = along([node], {A: ONE})
    point, step = np.array([0.4, 0.0]), np.array([1e-6, 0.0])
    rise = evaluate([node], point + step) - evaluate([node], point - step)
    assert evaluate([slope], point) == pytest.approx(rise / 2e-6, rel=1e-5)


def test_long_sums_and_deep_formulas_compile() -> None:
    total = sum((number(i) * A * float(i % 7) for i in range(1, 3000)), start=B)
    nested = A
    for _ in range(500):
        nested = ONE / (ONE + nested)
    found = evaluate([total, nested], np.array([1.0, 2.0]))
    assert found[0] == 2.0 + sum(i * (i % 7) for i in range(1, 3000))
    assert found[1] == pytest.approx((math.sqrt(5.0) - 1.0) / 2.0)


def test_substitution_and_the_variables_that_are_left() -> None:
    (node,) = read([x * sin(y) + abs(x)], NODES)
    (at_zero,) = substitute([node], {B: ZERO})
    assert variables_of([at_zero]) == {A}
    assert at_zero is read([abs(x)], NODES)[0]


def test_nodes_that_nobody_needs_are_forgotten() -> None:
    node = number(0.1234567) * A
    forgotten = weakref.ref(node)
    del node
    gc.collect()
    assert forgotten() is None
