"""A specification for a simulator that nobody has described yet, from a few episodes whose steps are counted.

The steps show ranges, limits and coordinates. The file asks in plain words for everything that steps can't show.
"""

from surrogym_client.original.describing.description import Description, describe
from surrogym_client.original.describing.exploring import STEPS

__all__ = ["STEPS", "Description", "describe"]
