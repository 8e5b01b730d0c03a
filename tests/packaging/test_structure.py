"""The client stays a house: short functions, few loose files. The directions are import-linter's."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import surrogym_client

HERE = Path(surrogym_client.__file__).parent
LONGEST = 60  # lines of a function
LOOSE = 8


def functions() -> Iterator[tuple[str, int]]:
    for path in HERE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno is not None:
                yield f"{path.relative_to(HERE)}: {node.name}", node.end_lineno - node.lineno + 1


def test_no_function_is_longer_than_a_screen():
    assert {name: lines for name, lines in functions() if lines > LONGEST} == {}


def test_few_files_are_in_no_room():
    assert len(list(HERE.glob("*.py"))) <= LOOSE
