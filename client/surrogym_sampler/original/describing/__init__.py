"""Draft the specification of a simulator that has none, from a few episodes whose steps are counted.

The steps show ranges, limits and coordinates. The drafted file asks a person for everything that steps can't show.
"""

from surrogym_sampler.original.describing.description import Description, DescriptionInterrupted, describe
from surrogym_sampler.original.describing.exploring import STEPS

__all__ = ["STEPS", "Description", "DescriptionInterrupted", "describe"]
