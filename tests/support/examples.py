"""Runs the programs of examples/ as a person would: in a folder that holds them, against a server."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from support.server import ServerProcess

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
EXTRAS = Path(os.environ.get("SURROGYM_TEST_EXTRAS", ROOT / ".venv-extras")) / "bin" / "python"
needs_extras = pytest.mark.skipif(not EXTRAS.exists(), reason="no .venv-extras here: make test-all makes it")


def run(server: ServerProcess, folder: Path, *arguments: str, python: str = sys.executable, **environment: str) -> str:
    """What ``python ARGUMENTS`` prints, run in ``folder`` with the examples importable and ``surrogym`` at hand.

    Raises:
        AssertionError: it fails; with what it said.
    """
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    sources = [str(EXAMPLES), os.environ.get("PYTHONPATH", "")]
    settings = {"PATH": path, "PYTHONPATH": os.pathsep.join(sources), "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    command = [python, *arguments]
    environment = os.environ | settings | {"SURROGYM_URL": server.url} | environment
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def surrogym(server: ServerProcess, folder: Path, *arguments: str, **environment: str) -> str:
    """What ``surrogym ARGUMENTS`` prints."""
    return run(server, folder, "-m", "surrogym", *arguments, **environment)


def cells(notebook: Path) -> str:
    """The code of a notebook as one program; expressions at the end of cells are computed, and not shown."""
    content = json.loads(notebook.read_text(encoding="utf-8"))
    return "\n\n".join("".join(cell["source"]) for cell in content["cells"] if cell["cell_type"] == "code")
