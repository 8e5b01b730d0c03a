"""Export of a learned model for other programs, as an FMU that steps like a session of the model."""

from surrogym_server.deployment.twin import MOST_NUMBERS, twin_of, write_twin

__all__ = ["MOST_NUMBERS", "twin_of", "write_twin"]
