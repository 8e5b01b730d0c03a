"""The target ``st``: structured text of IEC 61131-3, for programmable logic controllers."""

from surrogym_trainer.deployment.st.source import REAL_TYPES, source_of, write

__all__ = ["REAL_TYPES", "source_of", "write"]
