"""A specification for a simulator that nobody has described yet, from a few episodes whose steps are counted.

What can be found out is found out; what can't is asked for in plain words.
"""

from surrogym_client.original.describing.description import Description, describe
from surrogym_client.original.describing.exploring import STEPS

__all__ = ["STEPS", "Description", "describe"]
