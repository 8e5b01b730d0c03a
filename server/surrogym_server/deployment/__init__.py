"""A learned model for other programs: an FMU that steps as the served model does."""

from surrogym_server.deployment.twin import MOST_NUMBERS, twin_of, write_twin

__all__ = ["MOST_NUMBERS", "twin_of", "write_twin"]
