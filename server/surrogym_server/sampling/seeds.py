"""Random generators of a design: an independent one for each purpose, all from the design's seed."""

from __future__ import annotations

import numpy as np

from surrogym_server.environment.definition import EnvironmentDefinition


def generator_for(definition: EnvironmentDefinition, purpose: str) -> np.random.Generator:
    """Return a new random generator for a purpose, such as `initial`. The same seed and purpose give the same
    numbers."""
    return np.random.default_rng([definition.design.seed, *purpose.encode()])
