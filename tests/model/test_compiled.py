from __future__ import annotations

from collections.abc import Iterable
import inspect
import math
import os
import subprocess
import sys
from typing import Any

import numpy as np
from pydrake.symbolic import (
    Expression,
    Variable,
    atan2,
    exp,
    if_then_else,
    logical_and,
    max,
    min,
    pow,
    sqrt,
    uninterpreted_function,
)
import pytest

from vcbf_drake.model.formulas import CompiledFunction, compile_nodes, read
from vcbf_drake.model.graph import variable

x, y, z = Variable("x"), Variable("y"), Variable("z")
EXPRESSIONS = [
    sqrt(x * x + y * y) / (1.0 + z * z),
    pow(sqrt(x * x + y * y), -3),
    pow(abs(x), y),
    atan2(y, x),
    max(x, min(y, z)),
    if_then_else(logical_and(x > 0.0, y <= z), x * y, z / 3.0),
    exp(x) + Expression(y).Differentiate(y),
    x / 3.0 + 0.1 * y,
    Expression(z),
]


def compiled(arguments: Iterable[Variable], expressions: Any) -> CompiledFunction:
    """The function of pydrake's expressions, in C order."""
    nodes = {v: variable(v.get_name()) for v in arguments}
    outputs = read(expressions, nodes).ravel()
    return compile_nodes([*nodes.values()], outputs)


def test_values_are_those_of_the_expressions() -> None:
    function = compiled([x, y, z], EXPRESSIONS)
    random = np.random.default_rng(0)
    for _ in range(20):
        point = random.normal(size=3).tolist()
        environment = dict(zip([x, y, z], point, strict=True))
        expected = [e.Evaluate(environment) for e in EXPRESSIONS]
        np.testing.assert_allclose(function(*point), expected, rtol=1e-14)


def test_constants_keep_all_their_digits() -> None:
    (value,) = compiled([x], [x * (1.0 / 3.0)])(1.0)
    assert value == 1.0 / 3.0


def test_arrays_variables_and_numbers_are_flattened_in_order() -> None:
    function = compiled([x, y], np.array([[x, 2], [x * y, 0.5]]))
    assert function(3.0, 4.0) == [3.0, 2.0, 12.0, 0.5]
    assert all(isinstance(value, float) for value in function(3.0, 4.0))


@pytest.mark.parametrize(
    ("expression", "point", "error"),
    [
        (1.0 / x, 0.0, ZeroDivisionError),
        (sqrt(x), -1.0, ValueError),
        (pow(sqrt(x), 3), -1.0, ValueError),
        (exp(x), 1e3, OverflowError),
    ],
)
def test_singular_points_raise(
    expression: Expression, point: float, error: type[Exception]
) -> None:
    with pytest.raises(error):
        compiled([x], [expression])(point)


def test_unknown_variables_are_named() -> None:
    with pytest.raises(KeyError, match="y"):
        compiled([x], [x + y, z])
    with pytest.raises(ValueError, match="rows: not among its arguments: y, z"):
        compile_nodes([variable("x")], map(variable, "xyz"), name="rows")


def test_what_python_cannot_say_is_refused() -> None:
    with pytest.raises(NotImplementedError):
        compiled([x], [uninterpreted_function("f", [Expression(x)])])


def test_code_is_the_same_in_every_process() -> None:
    program = (
        "import inspect, test_compiled as t\n"
        "f = t.compiled([t.x, t.y, t.z], t.EXPRESSIONS)\n"
        "print(inspect.getsource(f), [v.hex() for v in f(0.3, -0.7, 1.1)])\n"
    )
    path = os.pathsep.join([os.path.dirname(__file__), *sys.path])
    outputs = {
        subprocess.run(
            [sys.executable, "-c", program],
            env=os.environ | {"PYTHONHASHSEED": seed, "PYTHONPATH": path},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("0", "1", "2")
    }
    assert len(outputs) == 1
    # A process that compiled other things before must agree too.
    function = compiled([x, y, z], EXPRESSIONS)
    assert inspect.getsource(function) in outputs.pop()
    assert math.isfinite(sum(function(0.3, -0.7, 1.1)))
