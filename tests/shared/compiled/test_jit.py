"""Compiled functions are kept in a folder of the user's own, and compiled again where there is none."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("numba")

PROGRAM = """
from numba import types
from surrogym_shared.compiled import jit

@jit.entry(types.float64)
def twice(x):
    return 2 * x

print(twice(2.0), sum(twice.stats.cache_hits.values()))
"""


def run(tmp_path: Path, kept: Path) -> str:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(kept), "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, str(program)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.strip()


def test_a_second_process_loads_the_compiled_functions_of_the_first(tmp_path: Path):
    assert run(tmp_path, tmp_path / "kept") == "4.0 0"
    assert run(tmp_path, tmp_path / "kept") == "4.0 1"


def test_a_compile_cache_folder_writable_by_others_is_not_used(tmp_path: Path):
    run(tmp_path, tmp_path / "kept")
    (folder,) = (tmp_path / "kept" / "surrogym").iterdir()
    assert folder.stat().st_mode & 0o077 == 0
    folder.chmod(0o777)
    assert run(tmp_path, tmp_path / "kept") == "4.0 0"


def test_a_process_without_a_writable_compile_cache_compiles_in_memory(tmp_path: Path):
    taken = tmp_path / "taken"
    taken.write_text("a file where a folder should be")
    assert run(tmp_path, taken) == "4.0 0"
