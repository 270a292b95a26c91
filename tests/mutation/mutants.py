"""Small faults in a module's source, one at a time."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import CodeType

_COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.GtE),
    ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.LtE),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.Mod: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
_TWINS = ("min max", "argmin argmax", "minimum maximum", "any all", "zeros ones")
_NAMES = {
    name: twin
    for one, other in (pair.split() for pair in _TWINS)
    for name, twin in ((one, other), (other, one))
}
_SYMMETRIC = {"max", "min", "maximum", "minimum"}
# Not behaviour, or read by people only.
_SKIPPED_FIELDS = {"annotation", "returns", "decorator_list"}
_SKIPPED_NODES = (ast.JoinedStr, ast.Import, ast.ImportFrom)


@dataclass(frozen=True)
class Mutant:
    """One fault.

    Attributes:
        line: Where it is.
        before: The code there.
        after: The code in its place.
        code: The module with the fault, compiled.
    """

    line: int
    before: str
    after: str
    code: CodeType


def mutants(source: str, path: str) -> Iterator[Mutant]:
    """Yields every mutant of a module, in the order of the source."""
    tree = ast.parse(source)
    for node, replace in _slots(tree):
        for changed in _alternatives(node):
            if ast.unparse(changed) == ast.unparse(node):
                continue
            ast.copy_location(changed, node)
            replace(changed)
            ast.fix_missing_locations(tree)
            yield Mutant(
                node.lineno,
                ast.unparse(node).partition("\n")[0],
                ast.unparse(changed).partition("\n")[0],
                compile(tree, path, "exec"),
            )
            replace(node)


_Replace = Callable[[ast.AST], None]


def _slots(parent: ast.AST) -> Iterator[tuple[ast.expr | ast.stmt, _Replace]]:
    """Every expression and statement below, with what puts another in its place."""
    for field, value in ast.iter_fields(parent):
        if field in _SKIPPED_FIELDS:
            continue
        many = isinstance(value, list)
        for i, child in enumerate(value if many else [value]):
            if not isinstance(child, ast.AST) or isinstance(child, _SKIPPED_NODES):
                continue

            def replace(
                node: ast.AST, i: int = i, field: str = field, value: object = value
            ) -> None:
                if isinstance(value, list):
                    value[i] = node
                else:
                    setattr(parent, field, node)

            if isinstance(child, (ast.expr, ast.stmt)):
                yield child, replace
            yield from _slots(child)


def _alternatives(node: ast.AST) -> Iterator[ast.AST]:
    """What may stand in a node's place."""
    match node:
        case ast.Compare():
            yield from _comparisons(node)
        case ast.BinOp(op=ast.MatMult()):
            yield ast.BinOp(node.right, node.op, node.left)
        case ast.BinOp() if type(node.op) in _OPERATORS:
            yield ast.BinOp(node.left, _OPERATORS[type(node.op)](), node.right)
        case ast.BoolOp():
            other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
            yield ast.BoolOp(other, node.values)
        case ast.UnaryOp():
            yield node.operand
        case ast.Constant():
            yield from map(ast.Constant, _constants(node.value))
        case ast.Name(ctx=ast.Load()) if node.id in _NAMES:
            yield ast.Name(_NAMES[node.id], node.ctx)
        case ast.Attribute(ctx=ast.Load()) if node.attr in _NAMES:
            yield ast.Attribute(node.value, _NAMES[node.attr], node.ctx)
        case ast.Slice() if node.lower or node.upper:
            yield ast.Slice(node.upper, node.lower, node.step)
        case ast.Call(args=[first, second, *rest]) if not (
            isinstance(first, ast.Starred)
            or isinstance(second, ast.Starred)
            or ast.unparse(node.func).rpartition(".")[2] in _SYMMETRIC
        ):
            yield ast.Call(node.func, [second, first, *rest], node.keywords)
        case ast.If(test=test) if not isinstance(test, (ast.Compare, ast.UnaryOp)):
            yield ast.If(ast.UnaryOp(ast.Not(), test), node.body, node.orelse)
        case ast.IfExp(test=test) if not isinstance(test, (ast.Compare, ast.UnaryOp)):
            yield ast.IfExp(ast.UnaryOp(ast.Not(), test), node.body, node.orelse)
        case ast.Return(value=ast.expr()):
            yield ast.Return(ast.Constant(None))
        case ast.Break():
            yield ast.Continue()
        case ast.Continue():
            yield ast.Break()
        case ast.AugAssign():
            if type(node.op) in _OPERATORS:
                other_op = _OPERATORS[type(node.op)]()
                yield ast.AugAssign(node.target, other_op, node.value)
            yield ast.Pass()
        case ast.Raise() | ast.Expr(value=ast.Call()):
            yield ast.Pass()
        case ast.Assign(targets=[ast.Subscript()]):
            yield ast.Pass()


def _comparisons(node: ast.Compare) -> Iterator[ast.AST]:
    for i, op in enumerate(node.ops):
        for other in _COMPARISONS[type(op)]:
            ops = [*node.ops[:i], other(), *node.ops[i + 1 :]]
            yield ast.Compare(node.left, ops, node.comparators)


def _constants(value: object) -> tuple[object, ...]:
    """Other values; of texts none, for they are names and messages."""
    match value:
        case bool():
            return (not value,)
        case int():
            return (value + 1,)
        case float() if value == 0.0:
            return (1.0,)
        case float() if 1e-3 <= abs(value) <= 1e3:
            return (2.0 * value,)
        case float():  # A tolerance, or a number as good as infinite.
            return (1e3 * value if abs(value) < 1.0 else 1e-3 * value,)
    return ()
