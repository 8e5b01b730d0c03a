"""The target ``fmu``: an FMU of FMI 3.0 around the controller in C, which fmpy can run.

The FMU decides at the beginning of each sampling period from the values of its inputs at that time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory
from typing import Any
from zipfile import ZipFile

import numpy as np

from surrogym_shared.c_compiler import require_c_compiler
from surrogym_shared.fmu import Block, Names, Variable, write_fmu
from surrogym_trainer.deployment.c.files import prefix_of, write_sources
from surrogym_trainer.deployment.c.source import number
from surrogym_trainer.deployment.controller import Array, Controller, NotDeployable
from surrogym_trainer.deployment.running import Running

STATUS = "0, or a sum of 1: not finite, 2: out of range, 4: late, 8: the network has no action"


def write(controller: Controller, folder: Path) -> None:
    """Write a controller as an FMU into a folder, with native code if a C compiler is installed.

    Raises:
        NotDeployable: no sampling period is declared, or two variables have the same name.
        CannotCompile: the compiler refused the sources.
    """
    try:
        write_fmu(block_of(controller), folder / f"{prefix_of(controller)}_controller.fmu")
    except ValueError as error:
        raise NotDeployable(str(error)) from error


def block_of(controller: Controller) -> Block:
    """Return a controller as the block that an FMU is made from. Raises ``NotDeployable`` if no sampling period is
    declared."""
    if controller.period is None:
        raise NotDeployable(
            "an FMU needs a period, and none is declared: give it by --period, or by sampling_period in the "
            "specification"
        )
    prefix = prefix_of(controller)
    names = {"prefix": prefix, "PREFIX": prefix.upper(), "fallback": ", ".join(map(number, controller.fallback))}
    glue = Template(files(__package__).joinpath("fmu_block.c.txt").read_text(encoding="utf-8")).substitute(names)
    digests = ", ".join(f"{name} {value[:16]}" for name, value in sorted(controller.digests.items()))
    return Block(
        name=f"{prefix}_controller",
        description=f"Controller of {controller.name}: {digests}",
        variables=tuple(_variables(controller)),
        period=controller.period,
        stop=None,
        sources={**_sources(controller), f"{prefix}_block.c": glue},
        memory=len(controller.coordinates) + len(controller.low) + 1,
        acts_first=True,
    )


def _sources(controller: Controller) -> dict[str, str]:
    """Return the header and the source of the controller in C, by file name."""
    with TemporaryDirectory() as folder:
        write_sources(controller, Path(folder))
        return {path.name: path.read_text(encoding="utf-8") for path in sorted(Path(folder).iterdir())}


def _variables(controller: Controller) -> Iterator[Variable]:
    """Yield all variables of a controller's FMU, in the order in which ``fmu_block.c.txt`` reads their values. If a
    name is already used, the variable's kind is put before the name."""
    free = Names().free
    for one in controller.measurements:
        about = f"measurement, from {one.lowest:.6g} to {one.highest:.6g}"
        start = min(max(0.0, one.lowest), one.highest)
        yield Variable(free(one.name, "measurement"), "Float64", "input", start, unit=one.unit, description=about)
    about = "of the measurements, in seconds"
    yield Variable(free("age", "controller"), "Float64", "input", 0.0, description=about)
    for index, (low, high) in enumerate(zip(controller.low.tolist(), controller.high.tolist(), strict=True)):
        name = "action" if len(controller.low) == 1 else f"action_{index}"
        ends = (low, high) if math.isfinite(low) and math.isfinite(high) else (None, None)
        yield Variable(free(name, "controller"), "Float64", "output", None, *ends)
    yield Variable(free("status", "controller"), "Int32", "output", description=STATUS)


class RunningFmu(Running):
    """A controller's FMU, which takes one step per sampling period.

    Args:
        fmu: the instance in fmpy.
        controller: the controller that the FMU was made from.
        period: seconds of a step.
    """

    def __init__(self, fmu: Any, controller: Controller, period: float) -> None:
        self._fmu, self._period, self._steps = fmu, period, 0
        # the age of the measurements is one more input of the FMU
        inputs, actions = len(controller.measurements) + 1, len(controller.low)
        self._inputs = list(range(1, inputs + 1))
        self._actions = list(range(inputs + 1, inputs + actions + 1))
        self._status = [inputs + actions + 1]
        self._initialise()

    def reset(self) -> None:
        self._fmu.reset()
        self._initialise()

    def step(self, measurement: Array, age: float = 0.0) -> tuple[int, Array]:
        self._fmu.setFloat64(self._inputs, [*measurement.tolist(), age])
        self._fmu.doStep(currentCommunicationPoint=self._steps * self._period, communicationStepSize=self._period)
        self._steps += 1
        return int(self._fmu.getInt32(self._status)[0]), np.array(self._fmu.getFloat64(self._actions))

    def _initialise(self) -> None:
        self._fmu.enterInitializationMode()
        self._fmu.exitInitializationMode()
        self._steps = 0


@contextmanager
def running(controller: Controller) -> Iterator[RunningFmu]:
    """Write the FMU of a controller with native code, and load it.

    Raises:
        NotDeployable: no sampling period is declared.
        CannotCompile: there is no C compiler, or it refuses the sources.
        ModuleNotFoundError: the extra ``fmu`` is not installed.
    """
    from fmpy.fmi3 import FMU3Slave

    require_c_compiler()
    block = block_of(controller)
    with TemporaryDirectory() as made:
        path = Path(made, "controller.fmu")
        write_fmu(block, path)
        with ZipFile(path) as archive:
            archive.extractall(made)
        fmu = FMU3Slave(
            guid=block.token, unzipDirectory=made, modelIdentifier=block.identifier, instanceName=block.identifier
        )
        fmu.instantiate()
        try:
            yield RunningFmu(fmu, controller, block.period)
        finally:
            fmu.freeInstance()
