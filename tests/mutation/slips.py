"""Slips of one operator, constant, sign, axis, comparison or order of arguments in a source text."""

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
_PAIRS = (("sin", "cos"), ("min", "max"), ("amin", "amax"), ("mean", "sum"))
_NAMES = {**dict(_PAIRS), **{b: a for a, b in _PAIRS}}


class Slip(NamedTuple):
    """A changed source text."""

    line: int
    what: str
    source: str


def slips(source: str) -> list[Slip]:
    """Every slip of a source text, one at a time; messages, docstrings and annotations are left alone."""
    found = []
    for index in range(len(list(_changes(ast.parse(source))))):
        tree = ast.parse(source)
        node, change, what = list(_changes(tree))[index]
        line = getattr(node, "lineno", 0)
        change(node)
        found.append(Slip(line, what, ast.unparse(tree)))
    return found


def _changes(tree: ast.AST) -> Iterator[tuple[ast.AST, Callable[[ast.AST], None], str]]:
    """Nodes in order, with what changes each in place and its description."""
    for node in _computing(tree):
        if isinstance(node, ast.BinOp | ast.AugAssign | ast.BoolOp) and type(node.op) in _OPERATORS:
            new = _OPERATORS[type(node.op)]
            yield (
                node,
                lambda n, new=new: setattr(n, "op", new()),
                f"{type(node.op).__name__} to {new.__name__}",
            )
        elif isinstance(node, ast.Compare) and type(node.ops[0]) in _OPERATORS:
            old, new = type(node.ops[0]), _OPERATORS[type(node.ops[0])]
            yield node, lambda n, new=new: n.ops.__setitem__(0, new()), f"{old.__name__} to {new.__name__}"
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            yield node, lambda n: setattr(n, "op", ast.UAdd()), "minus dropped"
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
            new_value = node.value + 1 if isinstance(node.value, int) else node.value * 1.25 + 1e-3
            yield node, lambda n, v=new_value: setattr(n, "value", v), f"{node.value} to {new_value}"
        elif isinstance(node, ast.Constant) and type(node.value) is bool:
            yield node, lambda n: setattr(n, "value", not n.value), f"{node.value} to {not node.value}"
        elif isinstance(node, ast.Attribute) and node.attr in _NAMES:
            yield node, lambda n: setattr(n, "attr", _NAMES[n.attr]), f"{node.attr} to {_NAMES[node.attr]}"
        elif isinstance(node, ast.List) and len(node.elts) == 2 and isinstance(node.ctx, ast.Load):
            yield node, lambda n: n.elts.reverse(), "order of two"


def _computing(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes of a tree in order, without raised messages, checks, docstrings, decorators and annotations."""
    for child in ast.iter_child_nodes(tree):
        if isinstance(
            child, ast.Raise | ast.Assert | ast.JoinedStr | ast.AnnAssign | ast.Import | ast.ImportFrom
        ):
            if isinstance(child, ast.AnnAssign) and child.value is not None:
                yield from _computing(ast.Expr(child.value))
            continue
        if isinstance(child, ast.Call) and ast.unparse(child.func).split(".")[-1].startswith("check_"):
            continue
        if isinstance(child, ast.arg):
            continue
        if isinstance(child, ast.FunctionDef):
            child = copy.copy(child)
            child.returns, child.decorator_list = None, []
        yield child
        yield from _computing(child)
