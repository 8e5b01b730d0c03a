"""C compilers of this machine, and a compiled controller as a function."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from surrogym_trainer.deployment.c.files import prefix_of, write
from surrogym_trainer.deployment.controller import Controller

STRICT = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic")
SANITIZED = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
NEEDS_C = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler on this machine: apt-get install gcc")


def compile_c(compiler: str, sources: list[Path], out: Path, *flags: str) -> Path:
    """Compile C sources without a warning."""
    command = [compiler, *STRICT, *flags, *map(str, sources), "-lm", "-o", str(out)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    return out


def run(program: Path, *arguments: str) -> str:
    """Output of a program that ends with 0."""
    result = subprocess.run([program, *arguments], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-2000:]
    return result.stdout


class Compiled:
    """A controller as a shared library in this process.

    Args:
        controller: what is compiled.
        folder: where it is compiled.
        single: compute in float.
        compiler: on the path.
    """

    def __init__(self, controller: Controller, folder: Path, *, single: bool = False, compiler: str = "cc") -> None:
        folder.mkdir(parents=True, exist_ok=True)
        write(controller, folder)
        self._prefix = prefix_of(controller)
        flags = ["-shared", "-fPIC", *([f"-D{self._prefix.upper()}_FLOAT"] if single else [])]
        source = folder / f"{self._prefix}_controller.c"
        self._library = ctypes.CDLL(str(compile_c(compiler, [source], folder / "controller.so", *flags)))
        self._real = np.float32 if single else np.float64
        self._number = ctypes.c_float if single else ctypes.c_double
        self._coordinates, self._actions = len(controller.coordinates), len(controller.low)
        self._observations = len(controller.observation)
        self._state = np.zeros(self._coordinates + self._actions + 4, dtype=self._real)
        self._step = self._library[f"{self._prefix}_step"]
        self._action = np.zeros(self._actions, dtype=self._real)
        self.reset()

    def reset(self) -> None:
        self._library[f"{self._prefix}_reset"](self._at(self._state))

    def step(self, measurement: np.ndarray, age: float = 0.0) -> tuple[int, np.ndarray]:
        read = np.ascontiguousarray(measurement, dtype=self._real)
        status = self._step(self._at(self._state), self._at(read), self._number(age), self._at(self._action))
        return int(status), self._action.astype(np.float64)

    @property
    def coordinates(self) -> np.ndarray:
        """What it remembers, (C,)."""
        return self._state[: self._coordinates].astype(np.float64)

    def observed(self) -> np.ndarray:
        """What the policy observed in the last step, (D,)."""
        shown = np.zeros(self._observations, dtype=self._real)
        self._library[f"{self._prefix}_observe"](self._at(self._state), self._at(shown))
        return shown

    @staticmethod
    def _at(array: np.ndarray) -> ctypes.c_void_p:
        return ctypes.c_void_p(array.ctypes.data)


def called_by_name(object_file: Path) -> set[str]:
    """Names that an object file needs from elsewhere."""
    listed = subprocess.run(["nm", "--undefined-only", object_file], capture_output=True, text=True, check=True).stdout
    return set(re.findall(r"\bU (\w+)", listed))


def calls(graph: Path) -> dict[str, set[str]]:
    """Who calls whom, from the graph of ``gcc -fcallgraph-info``."""
    edges = re.findall(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"', graph.read_text())
    found: dict[str, set[str]] = {}
    for caller, called in edges:
        found.setdefault(caller, set()).add(called)
    return found


def recursive(graph: dict[str, set[str]]) -> set[str]:
    """Functions that can reach themselves."""

    def reached(start: str) -> set[str]:
        seen: set[str] = set()
        left = [*graph.get(start, ())]
        while left:
            if (one := left.pop()) not in seen:
                seen.add(one)
                left += graph.get(one, ())
        return seen

    return {name for name in graph if name in reached(name)}
