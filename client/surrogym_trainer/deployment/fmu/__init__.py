"""The target ``fmu``: an FMU of FMI 3.0 around the controller in C."""

from surrogym_trainer.deployment.fmu.controller import block_of, write
from surrogym_trainer.deployment.fmu.running import running

__all__ = ["block_of", "running", "write"]
