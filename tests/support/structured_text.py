"""Function blocks of structured text: parsed by blark, then run as Python.

Only what the generated blocks use is known: assignments, IF, FOR, CASE, arrays from 0, REAL, LREAL, DINT and BOOL, EXP,
SIN, COS, TRUNC and conversions. Anything else raises ``UnknownText``. An index outside of its array raises
``IndexError``, which a controller would not.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from blark import transform as ast
from blark.parse import parse_source_code

TYPES: dict[str, Callable[[Any], Any]] = {"LREAL": float, "REAL": np.float32, "DINT": int, "BOOL": bool}
OPERATORS = {"=": "==", "<>": "!=", "AND": "and", "OR": "or", "NOT": "not"}
SHORT = 4  # values of an array that blark reads
SAME = ("+", "-", "*", "/", "<", ">", "<=", ">=")
FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "TRUNC": int,
    "DINT_TO_LREAL": float,
    "DINT_TO_REAL": np.float32,
    "LREAL_TO_REAL": np.float32,
    "REAL_TO_LREAL": float,
}
OF_NUMBERS = {"EXP": (math.exp, np.exp), "SIN": (math.sin, np.sin), "COS": (math.cos, np.cos)}  # by LREAL and REAL


class UnknownText(Exception):
    """The block uses something that this interpreter does not know."""


class Array(list[Any]):
    """Values of one type, with the indices 0 to n - 1."""

    def __init__(self, values: list[Any], kind: Callable[[Any], Any]) -> None:
        super().__init__(map(kind, values))
        self.kind = kind

    def __getitem__(self, index: Any) -> Any:
        return super().__getitem__(self._checked(index))

    def __setitem__(self, index: Any, value: Any) -> None:
        super().__setitem__(self._checked(index), self.kind(value))

    def _checked(self, index: int) -> int:
        if not 0 <= index < len(self):
            raise IndexError(f"index {index} of an array of {len(self)}")
        return index


class FunctionBlock:
    """One instance of a function block. ``values`` are its variables by name."""

    def __init__(self, text: str) -> None:
        short, arrays = _without_long_arrays(text)
        parsed = parse_source_code(short)
        if parsed.exception is not None:
            raise parsed.exception
        (block,) = parsed.transform().items
        self.name = str(block.name)
        self.values: dict[str, Any] = {}
        self.inputs: list[str] = []
        self.outputs: list[str] = []
        self._kinds: dict[str, Callable[[Any], Any]] = {}
        self._arrays = arrays
        for declared in block.declarations:
            names = [name for item in declared.items for name in self._declare(item)]
            self.inputs += names if isinstance(declared, ast.InputDeclarations) else []
            self.outputs += names if isinstance(declared, ast.OutputDeclarations) else []
        single = any(kind is np.float32 for kind in self._kinds.values())
        known = {**FUNCTIONS, **{name: both[single] for name, both in OF_NUMBERS.items()}}
        program = "\n".join(["def run(v, kinds):", *self._block(block.body, 1)])
        made: dict[str, Any] = dict(known)
        exec(compile(program, self.name, "exec"), made)
        self._run: Callable[[dict[str, Any], dict[str, Any]], None] = made["run"]

    def __call__(self, **inputs: Any) -> None:
        """Call the block with these inputs; arrays as sequences."""
        for name, value in inputs.items():
            if name not in self.inputs:
                raise UnknownText(f"no input {name}")
            self._set(name, value)
        with np.errstate(all="ignore"):
            self._run(self.values, self._kinds)

    def _set(self, name: str, value: Any) -> None:
        kind, old = self._kinds[name], self.values[name]
        if isinstance(old, Array):
            assert len(value) == len(old)
        self.values[name] = Array(list(value), kind) if isinstance(old, Array) else kind(value)

    def _declare(self, item: Any) -> Iterator[str]:
        names = [str(one.variable.name) for one in item.variables]
        match item.init:
            case ast.ArrayTypeInitialization() as made:
                kind, count = _type(made.spec.type), _size(made)
                values = self._arrays.get(names[0]) or (
                    [0] * count if made.value is None else list(_elements(made.value))
                )
                if len(values) != count:
                    raise UnknownText(f"{names}: {len(values)} values for {count}")
                start: Any = Array(values, kind)
            case ast.TypeInitialization() as made:
                kind = _type(made.spec.type)
                start = kind(0 if made.value is None else _literal(made.value))
            case other:
                raise UnknownText(repr(other))
        for name in names:
            self._kinds[name] = kind
            self.values[name] = Array(list(start), kind) if isinstance(start, Array) else start
            yield name

    def _block(self, statements: Any, depth: int) -> Iterator[str]:
        pad, listed = "    " * depth, [] if statements is None else statements.statements
        if not listed:
            yield f"{pad}pass"
        for one in listed:
            yield from (pad + line for line in self._statement(one))

    def _statement(self, one: Any) -> Iterator[str]:
        match one:
            case ast.AssignmentStatement(variables=[target]):
                value = self._expression(one.expression)
                if isinstance(target, ast.SimpleVariable):
                    value = f"kinds[{str(target.name)!r}]({value})"
                yield f"{self._expression(target)} = {value}"
            case ast.IfStatement():
                yield f"if {self._expression(one.if_expression)}:"
                yield from self._block(one.statements, 1)
                for other in one.else_ifs:
                    yield f"elif {self._expression(other.if_expression)}:"
                    yield from self._block(other.statements, 1)
                yield from self._else(one)
            case ast.ForStatement(step=None):
                first, last = self._expression(one.from_), self._expression(one.to)
                yield f"for counted in range({first}, {last} + 1):"
                yield f"    {self._expression(one.control)} = counted"
                yield from self._block(one.statements, 1)
            case ast.CaseStatement():
                chosen = self._expression(one.expression)
                for place, case in enumerate(one.cases):
                    (match_,) = case.matches
                    yield f"{'if' if place == 0 else 'elif'} {chosen} == {_literal(match_)}:"
                    yield from self._block(case.statements, 1)
                yield from self._else(one)
            case _:
                raise UnknownText(repr(one))

    def _else(self, one: Any) -> Iterator[str]:
        if one.else_clause is not None:
            yield "else:"
            yield from self._block(one.else_clause.statements, 1)

    def _expression(self, one: Any) -> str:
        match one:
            case ast.SimpleVariable():
                if str(one.name) not in self.values:
                    raise UnknownText(f"no variable {one.name}")
                return f"v[{str(one.name)!r}]"
            case ast.MultiElementVariable(elements=[ast.SubscriptList(subscripts=[index])]):
                return f"{self._expression(one.name)}[{self._expression(index)}]"
            case ast.ParenthesizedExpression():
                return f"({self._expression(one.expr)})"
            case ast.UnaryOperation():
                return f"({_operator(one.op)} {self._expression(one.expr)})"
            case ast.BinaryOperation():
                return f"({self._expression(one.left)} {_operator(one.op)} {self._expression(one.right)})"
            case ast.FunctionCall(parameters=[given]) if str(one.name.name) in {*FUNCTIONS, *OF_NUMBERS}:
                return f"{one.name.name}({self._expression(given.value)})"
            case _:
                return repr(_literal(one))


def _without_long_arrays(text: str) -> tuple[str, dict[str, list[Any]]]:
    """Take the values of long arrays out of a text, because the time in which blark reads them grows with the cube of
    their number. Returns the text and the values by name."""
    taken: dict[str, list[Any]] = {}

    def replaced(found: re.Match[str]) -> str:
        values = [one.strip() for one in found["values"].split(",")]
        if len(values) <= SHORT:
            return found[0]
        taken[found["name"]] = [_plain(one) for one in values]
        return f"{found['head']};"

    return re.sub(r"(?P<head>(?P<name>\w+) : ARRAY\[[^]]*\] OF \w+) := \[(?P<values>[^]]*)\];", replaced, text), taken


def _plain(text: str) -> Any:
    """A literal, as the grammar of IEC 61131-3 has it."""
    if text in ("TRUE", "FALSE"):
        return text == "TRUE"
    if re.fullmatch(r"-?\d+", text):
        return int(text)
    if re.fullmatch(r"-?\d+\.\d+(E-?\d+)?", text):
        return float(text)
    raise UnknownText(text)


def _elements(given: Any) -> Iterator[Any]:
    """Literals of an array. blark sees a list without brackets as an element of the list with brackets."""
    for one in given.elements:
        if one.count is not None:
            raise UnknownText(repr(one))
        if isinstance(one.element, ast.ArrayInitialization):
            yield from _elements(one.element)
        else:
            yield _literal(one.element)


def _literal(one: Any) -> Any:
    match one:
        case ast.Real():
            return float(one.value)
        case ast.Integer():
            return int(one.value)
        case ast.Boolean():
            return str(one.value) == "TRUE"
        case ast.UnaryOperation() if str(one.op) == "-":
            return -_literal(one.expr)
        case _:
            raise UnknownText(repr(one))


def _operator(token: Any) -> str:
    text = str(token)
    if text not in SAME and text not in OPERATORS:
        raise UnknownText(text)
    return OPERATORS.get(text, text)


def _type(one: Any) -> Callable[[Any], Any]:
    name = str(getattr(one, "type_name", one))
    if name not in TYPES:
        raise UnknownText(name)
    return TYPES[name]


def _size(made: Any) -> int:
    (bounds,) = made.spec.subranges
    if str(bounds.start) != "0":
        raise UnknownText(f"an array from {bounds.start}")
    return int(str(bounds.stop)) + 1
