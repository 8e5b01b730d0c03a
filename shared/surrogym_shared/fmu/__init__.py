"""FMUs of FMI 3.0 for co-simulation, written around C99 source that steps at a fixed period."""

from surrogym_shared.fmu.archive import WrittenFmu, write_fmu
from surrogym_shared.fmu.block import Block, Causality, Names, Variable

__all__ = ["Block", "Causality", "Names", "Variable", "WrittenFmu", "write_fmu"]
