"""Compilation of a controller in C on this machine. The program is driven by lines of JSON, as original environments
are."""

from __future__ import annotations

import shlex
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from surrogym_sampler.original.executables.messages import numbers
from surrogym_sampler.original.executables.program import Program
from surrogym_shared.c_compiler import CannotCompile, compile_c, require_c_compiler
from surrogym_trainer.deployment.c.files import prefix_of, write
from surrogym_trainer.deployment.controller import Array, Controller, NotDeployable
from surrogym_trainer.deployment.running import Running

FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror")
SECONDS = 10.0  # the compiled program is stopped if it has not answered within this number of seconds


class CompiledController(Running):
    """A compiled controller, running as a program.

    Args:
        program: the program made from the controller's C sources.
        actions: number of entries of an action, F.
        microseconds: duration of one decision.
        single: whether it computes in float instead of double.
    """

    def __init__(self, program: Program, actions: int, microseconds: float, single: bool) -> None:
        self._program, self._actions = program, actions
        self.microseconds, self.single = microseconds, single

    def reset(self) -> None:
        self._program.ask("reset", time.monotonic() + SECONDS)

    def step(self, measurement: Array, age: float = 0.0) -> tuple[int, Array]:
        sent = [float(value) for value in measurement]
        reply = self._program.ask("step", time.monotonic() + SECONDS, measurement=sent, age=float(age))
        return int(reply["status"]), numbers(reply, "action", self._actions)


@contextmanager
def running(controller: Controller, *, single: bool = False) -> Iterator[CompiledController]:
    """Compile a controller, run its test vectors, and start it; with ``single`` it computes in float instead of double.

    Raises:
        CannotCompile: there is no C compiler, or it refuses the controller.
        NotDeployable: the compiled controller fails a test vector.
    """
    with TemporaryDirectory() as made:
        folder = Path(made)
        write(controller, folder)
        executable = folder / "controller"
        sources = sorted(path.name for path in folder.glob("*.c"))
        flags = (*FLAGS, f"-D{prefix_of(controller).upper()}_FLOAT") if single else FLAGS
        compile_c(require_c_compiler(), flags, sources, executable, folder)
        try:
            vectors = subprocess.run([executable], capture_output=True, text=True, check=False)
        except OSError as error:
            raise CannotCompile(
                f"expected a C compiler for this machine, got one whose program can't run here: {error.strerror}; "
                "set the variable CC to another one"
            ) from error
        if vectors.returncode != 0:
            raise NotDeployable(
                "the compiled controller gives other actions than the policy for its test observations, so it is not "
                f"used: try another C compiler (variable CC), or report this: {vectors.stdout[-400:]}"
            )
        timed = subprocess.run([executable, "time"], capture_output=True, text=True, check=True)
        program = Program(shlex.join([str(executable), "lines"]), "the compiled controller")
        program.start()
        try:
            yield CompiledController(program, len(controller.low), float(timed.stdout) / 1000, single)
        finally:
            program.close()
