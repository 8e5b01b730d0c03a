"""The target ``fmu``: an FMU of FMI 3.0 around the controller in C."""

from surrogym_trainer.deployment.fmu.controller import block_of, write

__all__ = ["block_of", "write"]
