"""Real steps in which dirt shows: random episodes that begin gently."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from surrogym_sampler.original.actions import random_action
from surrogym_sampler.original.lags import read_names
from surrogym_sampler.original.protocol import Array, RealStep, RolloutEnvironment
from surrogym_shared.dirt.rollouts import Rollout, rest_action
from surrogym_shared.spec import BoxAction, EnvironmentSpec

EPISODE = 20  # largest number of steps in an episode
HELD = 4  # largest number of steps for which a random action is held
# Random actions are scaled by one of these factors. The first steps have small ones: they show friction that sticks.
SCALES, GENTLE_SCALE, GENTLE = (1.0, 0.3, 0.1), 0.1, 4


def take(environment: RolloutEnvironment, spec: EnvironmentSpec, steps: int, seed: int = 0) -> list[Rollout]:
    """Take episodes with ``steps`` real steps in all.

    Args:
        environment: the opened environment.
        spec: its specification.
        steps: number of real steps.
        seed: fixes the actions, and is the seed of the first reset.

    Raises:
        StepFailed: a step failed.
    """
    return list(_episodes(environment, spec, steps, seed))


def _episodes(environment: RolloutEnvironment, spec: EnvironmentSpec, steps: int, seed: int) -> Iterator[Rollout]:
    rng, start = np.random.default_rng(seed), seed
    columns = [spec.coordinate_names.index(name) for name in read_names(spec)]
    while steps > 0:
        at, start = environment.begin(start), start + 1
        taken: list[RealStep] = []
        held, action = 0, np.zeros(0)
        while len(taken) < min(EPISODE, steps):
            if held == 0:
                held, action = int(rng.integers(1, HELD + 1)), _action(spec, rng, gentle=len(taken) < GENTLE)
            taken.append(environment.act(action))
            held -= 1
            if taken[-1].terminated or taken[-1].truncated:
                break
        steps -= len(taken)
        path = np.array([at, *(step.next_coordinates for step in taken)], dtype=np.float64)
        yield Rollout(path[:, columns], np.array([step.action for step in taken], dtype=np.float64))


def _action(spec: EnvironmentSpec, rng: np.random.Generator, *, gentle: bool) -> Array:
    """Return a random action (F,); a continuous one is scaled towards the action that counts as none."""
    action = random_action(spec, rng)
    if not isinstance(spec.action, BoxAction):
        return action
    scale, none = GENTLE_SCALE if gentle else float(rng.choice(SCALES)), rest_action(spec)
    return none + scale * (action - none)
