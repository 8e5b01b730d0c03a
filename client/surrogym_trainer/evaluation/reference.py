"""Reference controllers, with which a policy is compared, such as the controller in use today."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.factories import load_factory
from surrogym_trainer.policies.predict import PerEpisode

Controller = Callable[[NDArray[np.float64]], Any]
"""A function from an observation (D,) to an action: a number, or (F,)."""


class Reference(PerEpisode):
    """A controller written by a person.

    Each episode has a controller of its own, so that one with a memory, such as an integral part, starts afresh.
    """

    def __init__(self, make: Callable[[], Controller]) -> None:
        """Set the function ``make``, which makes the controller of an episode."""
        self._make = make
        self._controllers: dict[int, Controller] = {}

    def actions(self, episodes: Sequence[int], observations: NDArray[np.float32]) -> NDArray[Any]:
        """Return actions (N, F) for observations (N, D) of N episodes. Controllers of episodes that are not among them
        are dropped."""
        known = self._controllers
        self._controllers = {number: known[number] if number in known else self._make() for number in episodes}
        rows = zip(episodes, observations.astype(np.float64), strict=True)
        chosen = [self._controllers[number](row) for number, row in rows]
        return np.stack([np.asarray(action, dtype=np.float64).reshape(-1) for action in chosen])


def load_reference(name: str) -> Reference:
    """Load a controller by name. This runs the code of its module.

    Args:
        name: ``package.module:function``, a function of an observation; or ``package.module:Class``, whose instances
            are called with an observation. A class is called without arguments, once for each episode.

    Raises:
        UnknownEnvironment: there is no such module, or no callable of this name in it.
    """
    found = load_factory(name)
    return Reference(found if isinstance(found, type) else lambda: found)
