"""Functions stay short, and the client has few loose files. import-linter holds the directions of imports."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import surrogym
import surrogym_client
import surrogym_server
import surrogym_shared

CLIENT = Path(surrogym_client.__file__).parent
PACKAGES = [CLIENT, *(Path(str(package.__file__)).parent for package in (surrogym, surrogym_server, surrogym_shared))]
LONGEST = 60  # lines of a function
LOOSE = 8


def functions() -> Iterator[tuple[str, int]]:
    for path in (path for package in PACKAGES for path in package.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno is not None:
                yield f"{path}: {node.name}", node.end_lineno - node.lineno + 1


def test_no_function_is_longer_than_a_screen():
    assert {name: lines for name, lines in functions() if lines > LONGEST} == {}


def test_few_files_are_in_no_room():
    assert len(list(CLIENT.glob("*.py"))) <= LOOSE
