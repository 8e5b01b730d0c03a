"""Export of a learned model for other programs, as an FMU (functional mock-up unit) that steps like a session."""

from surrogym_server.deployment.twin import MOST_NUMBERS, twin_of, write_twin

__all__ = ["MOST_NUMBERS", "twin_of", "write_twin"]
