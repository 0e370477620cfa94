"""Changes one operator, constant, call or statement of a module at a time."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass

__all__ = ["Mutant", "iterate_mutants"]

COMPARISONS: dict[type[ast.cmpop], str] = {
    ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==",
    ast.Is: "is not", ast.IsNot: "is", ast.In: "not in", ast.NotIn: "in",
}  # fmt: skip
REVERSED: dict[type[ast.cmpop], str] = {ast.Lt: ">=", ast.LtE: ">", ast.Gt: "<=", ast.GtE: "<"}
OPERATORS: dict[type[ast.operator], str] = {
    ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.FloorDiv: "*", ast.Mod: "*",
    ast.Pow: "*",
    ast.BitAnd: "|", ast.BitOr: "&",
}  # fmt: skip
NAMES = {
    "min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum",
    "argmin": "argmax", "argmax": "argmin",
    "any": "all", "all": "any", "floor": "ceil", "ceil": "floor", "first": "last", "last": "first",
    "lower": "upper", "upper": "lower",
}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """A module with one fault.

    Attributes:
        module: Path in the package, such as "planning/solver/loop.py".
        line: Line of the fault, from 1.
        change: "kind: before → after".
        text: The unchanged line without indentation.
        users: Lines whose behaviour changes: the lines of its statement, or those that read the
            constant that it defines.
        source: Source code of the module with the fault.
    """

    module: str
    line: int
    change: str
    text: str
    users: tuple[int, ...]
    source: str


class _Source:
    """Source code, with access to nodes and replacements by byte position."""

    def __init__(self, source: str) -> None:
        self.bytes = source.encode()
        lines = self.bytes.splitlines(keepends=True)
        self.begins = [sum(len(line) for line in lines[:k]) for k in range(len(lines) + 1)]

    def get_span(self, node: ast.AST) -> tuple[int, int]:
        begin = self.begins[node.lineno - 1] + node.col_offset  # type: ignore[attr-defined]
        return begin, self.begins[node.end_lineno - 1] + node.end_col_offset  # type: ignore[attr-defined]

    def get_source(self, node: ast.AST) -> str:
        begin, end = self.get_span(node)
        return self.bytes[begin:end].decode()

    def replace(self, begin: int, end: int, replacement: str) -> str:
        return (self.bytes[:begin] + replacement.encode() + self.bytes[end:]).decode()


def iterate_mutants(module: str, source: str) -> Iterator[Mutant]:
    """Yield the faults of a module by line, except in strings, annotations and errors."""
    text, lines, tree = _Source(source), source.splitlines(), ast.parse(source)
    users, mutants = _find_users(tree), []
    for node in _iterate_nodes(tree):
        for kind, (begin, end), replacement in _iterate_faults(node, text):
            before = text.bytes[begin:end].decode()
            if before == replacement:
                continue
            changed = text.replace(begin, end, replacement)
            line = text.bytes[:begin].count(b"\n") + 1
            change = f"{kind}: {' '.join(before.split())} → {' '.join(replacement.split())}"
            mutant = Mutant(module, line, change, lines[line - 1].strip(), users[line], changed)
            mutants.append((begin, mutant))
    yield from (mutant for _, mutant in sorted(mutants, key=lambda pair: pair[0]))


def _find_users(tree: ast.Module) -> dict[int, tuple[int, ...]]:
    """Return line → the lines of its statement, or those that read the constant it defines."""
    users: dict[int, tuple[int, ...]] = {}
    for statement in ast.walk(tree):
        if isinstance(statement, ast.stmt):
            body = getattr(statement, "body", None)  # statements of the body have their own lines
            end = max(body[0].lineno - 1, statement.lineno) if body else statement.end_lineno
            span = tuple(range(statement.lineno, (end or statement.lineno) + 1))
            users |= dict.fromkeys(span, span)
    loads = [n for n in ast.walk(tree) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Load)]
    for item in tree.body:
        if isinstance(item, ast.Assign | ast.AnnAssign):
            targets = item.targets if isinstance(item, ast.Assign) else [item.target]
            nodes = [node for target in targets for node in ast.walk(target)]
            names = {node.id for node in nodes if isinstance(node, ast.Name)}
            using = tuple(sorted({node.lineno for node in loads if node.id in names}))
            if using:
                users |= dict.fromkeys(users[item.lineno], using)
    return users


def _iterate_nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes that may be changed."""
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        for child in value if isinstance(value, list) else [value]:
            excluded = (ast.Raise, ast.JoinedStr, ast.Import, ast.ImportFrom)
            if not isinstance(child, ast.AST) or isinstance(child, excluded) or _is_text(child):
                continue
            yield child
            yield from _iterate_nodes(child)


def _is_text(node: ast.AST) -> bool:
    """Return whether a statement is a docstring, `__all__` or a message."""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return True
    names = (
        [target.id for target in node.targets if isinstance(target, ast.Name)]
        if isinstance(node, ast.Assign)
        else []
    )
    return bool({"__all__", "detail", "expected", "why"} & set(names))


def _iterate_faults(node: ast.AST, text: _Source) -> Iterator[tuple[str, tuple[int, int], str]]:
    """Yield the kind, the byte span to replace and the replacement of each fault."""
    if isinstance(node, ast.Compare):
        yield from _change_comparisons(node, text)
    elif isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
        left, right = text.get_source(node.left), text.get_source(node.right)
        begin, end = text.get_span(node.left)[1], text.get_span(node.right)[0]
        gap = text.bytes[begin:end].decode()
        sign = next(
            (sign for sign in ("**", "//", "+", "-", "*", "/", "%", "&", "|") if sign in gap), None
        )
        if (
            sign is not None
            and not left.startswith(('"', "'"))
            and not right.startswith(('"', "'"))
        ):
            at = begin + gap.index(sign)
            yield "arithmetic", (at, at + len(sign)), OPERATORS[type(node.op)]
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
        yield "sign", text.get_span(node), f"({text.get_source(node.operand)})"
    elif isinstance(node, ast.BoolOp):
        begin, end = text.get_span(node.values[0])[1], text.get_span(node.values[1])[0]
        gap = text.bytes[begin:end].decode()
        old, new = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        yield "boolean", (begin + gap.index(old), begin + gap.index(old) + len(old)), new
    elif isinstance(node, ast.Constant):
        yield from _change_constants(node, text)
    elif isinstance(node, ast.If | ast.IfExp | ast.While) and not isinstance(
        node.test, ast.Compare
    ):
        yield "condition", text.get_span(node.test), f"(not ({text.get_source(node.test)}))"
    elif isinstance(node, ast.Call):
        yield from _change_calls(node, text)
    elif (
        (isinstance(node, ast.Expr) and isinstance(node.value, ast.Call))
        or isinstance(node, ast.AugAssign | ast.Continue | ast.Break)
        or (isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Subscript))
    ):
        yield "dropped", text.get_span(node), "pass"
    elif isinstance(node, ast.Attribute) and node.attr in NAMES:
        begin, end = text.get_span(node)
        yield "name", (end - len(node.attr), end), NAMES[node.attr]


def _change_comparisons(
    node: ast.Compare, text: _Source
) -> Iterator[tuple[str, tuple[int, int], str]]:
    sides = [node.left, *node.comparators]
    for k, operator in enumerate(node.ops):
        begin, end = text.get_span(sides[k])[1], text.get_span(sides[k + 1])[0]
        gap = text.bytes[begin:end]
        begin = begin + len(gap) - len(gap.lstrip(b") "))
        end = end - (len(gap) - len(gap.rstrip(b"( ")))
        yield "comparison", (begin, end), COMPARISONS[type(operator)]
        if type(operator) in REVERSED:
            yield "comparison", (begin, end), REVERSED[type(operator)]


def _change_constants(
    node: ast.Constant, text: _Source
) -> Iterator[tuple[str, tuple[int, int], str]]:
    if isinstance(node.value, bool):
        yield "constant", text.get_span(node), str(not node.value)
    elif isinstance(node.value, int):
        yield "constant", text.get_span(node), str(node.value + 1)
    elif isinstance(node.value, float):
        yield "constant", text.get_span(node), repr(node.value * 2 if node.value else 1.0)


def _change_calls(node: ast.Call, text: _Source) -> Iterator[tuple[str, tuple[int, int], str]]:
    if isinstance(node.func, ast.Name) and node.func.id in NAMES:
        yield "name", text.get_span(node.func), NAMES[node.func.id]
    first = node.args[:2]
    if len(first) == 2 and not any(
        isinstance(argument, ast.Starred | ast.GeneratorExp) for argument in first
    ):
        (begin, middle), (other, end) = (text.get_span(argument) for argument in first)
        between = text.bytes[middle:other].decode()
        yield (
            "swapped",
            (begin, end),
            f"{text.get_source(first[1])}{between}{text.get_source(first[0])}",
        )
