"""Peers: each installed by name from the package registry into an environment of its own, and a child process there."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import venv
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Self

SAME = [f"{name}=={version(name)}" for name in ("numpy", "scipy")]  # arithmetic and search as here
PACKAGES = {
    "openenv": ["openenv-core==0.3.0"],
    "rlmesh": ["rlmesh[gymnasium,numpy]==0.1.0"],
    "dm_env_rpc": ["dm-env-rpc==1.1.7"],
    "scikit_learn": ["scikit-learn==1.9.1", *SAME],
    "gpytorch": ["gpytorch==1.15.2", f"torch=={version('torch')}", *SAME],
}
SCRIPT = str(Path(__file__).with_name("peers.py"))
INSTALLING_SECONDS = 900


class PeerFailed(RuntimeError):
    """It can't be installed, or its process ended; says what was heard last."""


def installed(out: Path, name: str) -> str:
    """The Python that has a peer; the first time takes minutes.

    Raises:
        PeerFailed: pip's last words.
    """
    folder = out.resolve() / "peers" / name
    python, mark = folder / "bin/python", folder / "installed"
    if not python.exists():
        venv.create(folder, with_pip=True)
    if not mark.exists():
        print(f"installing {name} into {folder}", file=sys.stderr)
        command = [str(python), "-m", "pip", "install", "-q", *PACKAGES[name]]
        done = subprocess.run(command, capture_output=True, text=True, timeout=INSTALLING_SECONDS)
        if done.returncode:
            raise PeerFailed(f"pip: {(done.stderr.strip().splitlines() or ['no word'])[-1]}")
        mark.touch()
    return str(python)


class Child:
    """``peers.py WHAT NAME WHERE`` with a peer's Python: a subject whose calls are timed where they are made.

    Raises ``PeerFailed`` where it does not come up or ends.
    """

    def __init__(self, python: str, what: str, name: str, where: str) -> None:
        self._process = subprocess.Popen(
            [python, SCRIPT, what, name, where],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )
        self._read()

    def __call__(self, count: int) -> list[float]:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{count}\n")
        self._process.stdin.flush()
        return self._read()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.terminate()
        self._process.wait(30)

    def _read(self) -> list[float]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise PeerFailed("its process ended")
        answer: list[float] = json.loads(line)
        return answer
