"""Slips of one operator, constant, sign, axis, comparison, call or order of two in a source text."""

import ast
import copy
from collections.abc import Callable, Iterator
from typing import NamedTuple

_OPERATORS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
_PAIRS = (("sin", "cos"), ("min", "max"), ("amin", "amax"), ("argmin", "argmax"), ("mean", "sum"))
_NAMES = {**dict(_PAIRS), **{b: a for a, b in _PAIRS}}
#: Operands that need no parentheses when the sign before them goes.
_ATOMS = (ast.Constant, ast.Name, ast.Call, ast.Attribute, ast.Subscript)


class Slip(NamedTuple):
    """A changed source text, and where the change is.

    Attributes:
        line: the first line that it changes, from 1.
        lines: of the statement.
        by_import: the statement stands outside of functions, or is the head of one: the import runs it.
        before, after: the line.
        source: the whole text.
    """

    line: int
    lines: range
    by_import: bool
    before: str
    after: str
    source: str


def slips(source: str) -> list[Slip]:
    """Every slip of a source text, one at a time; messages, docstrings and annotations are left alone.

    Only the text of the changed expression is written anew: comments, and so comments on types, stay.
    """
    data = source.encode()
    starts = [0]
    for line in data.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = {}
    tree = ast.parse(source)
    statements = dict(_statements(tree, True))
    for node, text in _changes(tree):
        begin = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        changed = (data[:begin] + text.encode() + data[end:]).decode()
        before, after = (whole.splitlines()[node.lineno - 1].strip() for whole in (source, changed))
        slip = Slip(node.lineno, *statements[node.lineno], before, after, changed)
        found.setdefault((node.lineno, after), slip)
    return list(found.values())


def _statements(tree: ast.AST, by_import: bool) -> Iterator[tuple[int, tuple[range, bool]]]:
    """For each line the lines of its statement, of compound ones those of the head, and whether the import runs it."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.stmt):
            start = min([node.lineno, *(part.lineno for part in getattr(node, "decorator_list", []))])
            whole, body = range(start, node.end_lineno + 1), getattr(node, "body", None)
            head = range(start, max(node.lineno + 1, body[0].lineno)) if body else whole
            yield from ((line, (head if line in head else whole, by_import)) for line in whole)
        yield from _statements(node, by_import and not isinstance(node, ast.FunctionDef))


def _changes(tree: ast.AST) -> Iterator[tuple[ast.expr | ast.stmt, str]]:
    """Nodes in order, each with the text that takes its place."""

    def changed(node: ast.AST, change: Callable[[ast.AST], None]) -> tuple[ast.AST, str]:
        other = copy.deepcopy(node)
        change(other)
        return node, ast.unparse(other)

    for node in _computing(tree):
        if isinstance(node, ast.BinOp | ast.AugAssign | ast.BoolOp) and type(node.op) in _OPERATORS:
            yield changed(node, lambda n: setattr(n, "op", _OPERATORS[type(n.op)]()))
        elif isinstance(node, ast.Compare) and type(node.ops[0]) in _OPERATORS:
            yield changed(node, lambda n: n.ops.__setitem__(0, _OPERATORS[type(n.ops[0])]()))
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
            text = ast.unparse(node.operand)
            yield node, text if isinstance(node.operand, _ATOMS) else f"({text})"
        elif isinstance(node, ast.Constant) and type(node.value) is bool:
            yield node, str(not node.value)
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
            yield node, repr(node.value + 1 if isinstance(node.value, int) else node.value * 1.25 + 1e-3)
        elif isinstance(node, ast.Attribute) and node.attr in _NAMES:
            yield changed(node, lambda n: setattr(n, "attr", _NAMES[n.attr]))
        elif isinstance(node, ast.List) and len(node.elts) == 2 and isinstance(node.ctx, ast.Load):
            yield changed(node, lambda n: n.elts.reverse())
        elif (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Call)
            and "super()" not in ast.unparse(node)
        ):
            yield node, "pass"


def _computing(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes of a tree in order, without raised messages, checks, docstrings, decorators and annotations."""
    for child in ast.iter_child_nodes(tree):
        if isinstance(
            child, ast.Raise | ast.Assert | ast.JoinedStr | ast.AnnAssign | ast.Import | ast.ImportFrom
        ):
            if isinstance(child, ast.AnnAssign) and child.value is not None:
                yield from _computing(ast.Expr(child.value))
            continue
        call = child.value if isinstance(child, ast.Expr) else child
        if isinstance(call, ast.Call) and ast.unparse(call.func).split(".")[-1].startswith("check_"):
            continue
        if isinstance(child, ast.arg):
            continue
        if isinstance(child, ast.FunctionDef):
            child = copy.copy(child)
            child.returns, child.decorator_list = None, []
        yield child
        yield from _computing(child)
