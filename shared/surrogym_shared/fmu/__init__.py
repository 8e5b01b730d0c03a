"""FMUs of FMI 3.0 for co-simulation, written around C99 source that steps at a fixed period."""

from surrogym_shared.fmu.archive import CannotCompile, WrittenFmu, write_fmu
from surrogym_shared.fmu.block import TIME, Block, Causality, Variable

__all__ = ["TIME", "Block", "CannotCompile", "Causality", "Variable", "WrittenFmu", "write_fmu"]
