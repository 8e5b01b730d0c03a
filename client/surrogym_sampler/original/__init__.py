"""Original environments: the protocol, adapters for Gymnasium and MuJoCo, and loading of users' own environments.

Examples:
    >>> from surrogym_sampler import original
    >>> environment = original.make("Pendulum-v1", budget=30)
    >>> environment.step_from([3.1, 0.0], [2.0]).reward  # doctest: +ELLIPSIS
    -9.6...
"""

from surrogym_sampler.original.loading import make
from surrogym_sampler.original.protocol import OriginalEnvironment, RealStep, ResettableEnvironment

__all__ = ["OriginalEnvironment", "RealStep", "ResettableEnvironment", "make"]
