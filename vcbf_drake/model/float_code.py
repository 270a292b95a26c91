"""Plain Python code of symbolic expressions, written by SymPy.

A module of its own for SymPy's sake, which takes long to import: it is imported only
when code is written that no earlier run has left on disk.
"""

from __future__ import annotations

from collections.abc import Sequence
import inspect

from pydrake.symbolic import Expression, Variable, to_sympy
import sympy
from sympy.printing.pycode import PythonCodePrinter


def float_code(variables: Sequence[Variable], expressions: Sequence[Expression]) -> str:
    """The code of the function of floats that returns the expressions' values."""
    # Symbols named by position: to_sympy's own would sort by a process-wide count.
    symbols = [sympy.Symbol(f"a{i}") for i in range(len(variables))]
    memo = {v.get_id(): s for v, s in zip(variables, symbols, strict=True)}
    converted = [to_sympy(e, memo=memo) for e in expressions]
    function = sympy.lambdify(
        symbols,
        [sympy.Float(e) if e.is_Integer else e for e in converted],
        modules="math",
        printer=_FloatCodePrinter(),
        cse=True,
        docstring_limit=0,
    )
    return inspect.getsource(function)


class _FloatCodePrinter(PythonCodePrinter):
    """Prints constants in full and powers that stay real."""

    def __init__(self) -> None:
        super().__init__({"fully_qualified_modules": False})

    def _print_Float(self, number: sympy.Float) -> str:
        return repr(float(number))  # SymPy prints 15 digits: 1/3 would lose its last.

    def _print_Pow(self, power: sympy.Pow, rational: bool = False) -> str:
        if power.exp.is_Integer or abs(power.exp) == sympy.Rational(1, 2):
            return str(super()._print_Pow(power, rational=rational))
        # In Python (-1.0) ** 1.5 is a complex number, math.pow(-1.0, 1.5) an error.
        return f"pow({self._print(power.base)}, {self._print(power.exp)})"
