"""Compile a controller in C on this machine, and drive it by lines of JSON, as executables are."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from surrogym_sampler.original.executables.messages import numbers
from surrogym_sampler.original.executables.program import Program
from surrogym_shared.fmu import COMPILERS
from surrogym_trainer.deployment.c.files import write
from surrogym_trainer.deployment.controller import Array, Controller, NotDeployable
from surrogym_trainer.deployment.running import Running

FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror")
SECONDS = 10.0  # until the program answers


class CompiledController(Running):
    """A compiled controller.

    Args:
        program: executable of the controller's sources.
        actions: number of entries of an action, F.
        microseconds: of one decision.
    """

    def __init__(self, program: Program, actions: int, microseconds: float) -> None:
        self._program, self._actions = program, actions
        self.microseconds = microseconds

    def reset(self) -> None:
        self._program.ask("reset", time.monotonic() + SECONDS)

    def step(self, measurement: Array, age: float = 0.0) -> tuple[int, Array]:
        sent = [float(value) for value in measurement]
        reply = self._program.ask("step", time.monotonic() + SECONDS, measurement=sent, age=float(age))
        return int(reply["status"]), numbers(reply, "action", self._actions)


@contextmanager
def running(controller: Controller) -> Iterator[CompiledController]:
    """Compile a controller, run its test vectors and start it.

    Raises:
        NotDeployable: there is no C compiler, or the vectors fail.
    """
    with TemporaryDirectory() as made:
        folder = Path(made)
        write(controller, folder)
        executable = compiled(sorted(folder.glob("*.c")), folder / "controller")
        vectors = subprocess.run([executable], capture_output=True, text=True, check=False)
        if vectors.returncode != 0:
            raise NotDeployable(f"the compiled controller fails its vectors: {vectors.stdout[-400:]}")
        timed = subprocess.run([executable, "time"], capture_output=True, text=True, check=True)
        program = Program(shlex.join([str(executable), "lines"]), "the compiled controller")
        program.start()
        try:
            yield CompiledController(program, len(controller.low), float(timed.stdout) / 1000)
        finally:
            program.close()


def compiled(sources: list[Path], out: Path) -> Path:
    """Compile C sources for this machine.

    Raises:
        NotDeployable: there is none, or it refuses the sources.
    """
    compiler = c_compiler()
    command = [compiler, *FLAGS, *map(str, sources), "-lm", "-o", str(out)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        said = result.stderr[-400:] or f"exit status {result.returncode}"
        raise NotDeployable(f"{compiler} refuses the controller: {said}")
    return out


def c_compiler() -> str:
    """Return the first C compiler on the path. Raises ``NotDeployable`` if there is none."""
    compiler = next((found for name in COMPILERS if (found := shutil.which(name))), None)
    if compiler is None:
        raise NotDeployable(f"expected a C compiler ({', '.join(COMPILERS)}) on the path to check the controller")
    return compiler
