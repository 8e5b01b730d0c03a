"""Baselines without a policy: always the same action, or random ones.

The return of a baseline from the same starts shows how much of a policy's return is due to the policy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.network import counts_of
from surrogym_shared.spec import BoxAction, EnvironmentSpec
from surrogym_shared.wire import Controller
from surrogym_trainer.policies.predict import Predict


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
    counts = counts_of(spec)

    def choose(observations: NDArray[np.float32]) -> NDArray[Any]:
        return rng.integers(counts, size=(len(observations), len(counts)))

    def draw(observations: NDArray[np.float32]) -> NDArray[Any]:
        assert isinstance(spec.action, BoxAction)
        return rng.uniform(spec.action.low, spec.action.high, size=(len(observations), spec.action.size))

    return choose if counts else draw
