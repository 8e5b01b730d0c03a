"""Controllers with which a policy is compared: always the same action, random actions, or a reference, such as the
controller in use today.

The return of such a controller from the same starts shows how much of a policy's return is due to the policy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.factories import load_factory
from surrogym_shared.spec import BoxAction, EnvironmentSpec
from surrogym_shared.wire import Controller
from surrogym_trainer.policies.predict import PerEpisode, Predict


def default_baseline(spec: EnvironmentSpec) -> Controller:
    """Return the default baseline: an action of zero if the environment allows it, else random actions."""
    action = spec.action
    if not isinstance(action, BoxAction):
        return "random"
    zero = all(low <= 0 <= high for low, high in zip(action.low, action.high, strict=True))
    return "zero" if zero and action.bins is None else "random"


def baseline(spec: EnvironmentSpec, controller: Controller, seed: int = 0) -> Predict:
    """Return a policy that ignores its observations (N, D).

    Args:
        spec: specification of the environment.
        controller: ``zero`` for an action of zero, ``random`` for random actions.
        seed: seed of the random actions.

    Raises:
        ValueError: the controller is unknown, or ``zero`` for an environment without an action of zero.
    """
    if controller == "random":
        return _random(spec, np.random.default_rng(seed))
    if controller != "zero":
        raise ValueError(f"expected the controller zero or random, got {controller}")
    if default_baseline(spec) != "zero":
        raise ValueError(
            "the environment's actions do not include zero, so the controller zero can't act: compare with random "
            "actions"
        )

    def zero(observations: NDArray[np.float32]) -> NDArray[Any]:
        return np.zeros((len(observations), spec.action.size))

    return zero


def _random(spec: EnvironmentSpec, rng: np.random.Generator) -> Predict:
    counts = spec.action.policy_counts

    def choose(observations: NDArray[np.float32]) -> NDArray[Any]:
        return rng.integers(counts, size=(len(observations), len(counts)))

    def draw(observations: NDArray[np.float32]) -> NDArray[Any]:
        assert isinstance(spec.action, BoxAction)
        return rng.uniform(spec.action.low, spec.action.high, size=(len(observations), spec.action.size))

    return choose if counts else draw


Control = Callable[[NDArray[np.float64]], Any]
"""A function from an observation (D,) to an action: a number, or (F,)."""


class Reference(PerEpisode):
    """A controller written by a person.

    Each episode has a controller of its own, so that one with a memory, such as an integral part, starts afresh.
    """

    def __init__(self, make: Callable[[], Control]) -> None:
        """Set the function ``make``, which makes the controller of an episode."""
        self._make = make
        self._controllers: dict[int, Control] = {}

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
