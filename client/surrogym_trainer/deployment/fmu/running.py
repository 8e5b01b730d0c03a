"""A controller's FMU, run by fmpy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from zipfile import ZipFile

import numpy as np

from surrogym_shared.c_compiler import require_c_compiler
from surrogym_shared.fmu import write_fmu
from surrogym_trainer.deployment.controller import Array, Controller
from surrogym_trainer.deployment.fmu.controller import block_of
from surrogym_trainer.deployment.running import Running


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
