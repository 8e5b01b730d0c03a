"""Small policies as arrays, and what a policy does where the lanes are stepped one request at a time."""

from __future__ import annotations

from dataclasses import fields
from itertools import pairwise
from typing import Any

import numpy as np

from surrogym_client.errors import refused_here
from surrogym_shared.acting import ActingPolicy, Actor, NoiseKey
from surrogym_shared.codes import Code
from surrogym_shared.network import Layer
from surrogym_shared.port import PolicyPort, PolicyRollout, SurrogatePort


def random_policy(
    sizes: tuple[int, ...], dtype: Any = np.float32, *, continuous: bool = True, seed: int = 0
) -> ActingPolicy:
    """One of layers of these sizes, from the observation to the action."""
    rng = np.random.default_rng(seed)
    layers = [
        Layer(rng.normal(size=(i, o)).astype(dtype), 0.1 * rng.normal(size=o).astype(dtype)) for i, o in pairwise(sizes)
    ]
    return ActingPolicy(
        mean=0.1 * rng.normal(size=sizes[0]).astype(dtype),
        deviation=rng.uniform(0.5, 2, sizes[0]).astype(dtype),
        layers=tuple(layers),
        activation="tanh" if continuous else "relu",
        log_deviations=rng.normal(size=sizes[-1]).astype(dtype) if continuous else None,
    )


def stepped(
    port: SurrogatePort,
    session: str,
    actor: Actor,
    start: np.ndarray,
    steps: int,
    noise: NoiseKey | None = None,
    until: np.ndarray | None = None,
) -> PolicyRollout:
    """The same as ``rollout_policy``, one request a step; ``start`` (N, D) is what the lanes show."""
    observation, results, acted = start, [], []
    waiting = np.ones(len(start), dtype=bool) if until is None else until.copy()
    for t in range(steps):
        acted.append(actor.act(observation, None if noise is None else noise.later(t)))
        results.append(port.step(session, acted[-1].sent))
        observation = results[-1].observation
        waiting &= ~(results[-1].terminated | results[-1].truncated)
        if until is not None and not waiting.any():
            break
    log = None if noise is None else np.stack([one.log_probability for one in acted]).astype(np.float64)
    return PolicyRollout.of(results, np.stack([one.action for one in acted]).astype(np.float64), log)


def assert_same_rollout(ours: PolicyRollout, theirs: PolicyRollout) -> None:
    """Bit for bit."""
    for field in fields(ours):
        our, their = getattr(ours, field.name), getattr(theirs, field.name)
        np.testing.assert_array_equal(our, their, err_msg=field.name, strict=our is not None)


class Stepwise:
    """A surrogate that offers no rollouts of policies."""

    def __init__(self, port: SurrogatePort) -> None:
        self.spec, self.open, self.reset, self.step = port.spec, port.open, port.reset, port.step
        self.rollout, self.close, self.submit_occupancy = port.rollout, port.close, port.submit_occupancy


class Forgetful(Stepwise):
    """A surrogate that loses the session at one of its rollouts of a policy."""

    def __init__(self, port: PolicyPort, at: int) -> None:
        super().__init__(port)
        self._port, self._left = port, at

    def rollout_policy(self, session: str, *arguments: Any, **options: Any) -> PolicyRollout:
        self._left -= 1
        if self._left == 0:
            self.close(session)
            raise refused_here(Code.UNKNOWN_SESSION, "lost")
        return self._port.rollout_policy(session, *arguments, **options)
