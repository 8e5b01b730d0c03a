"""MBPO: a soft actor-critic that learns from short rollouts of an ensemble, which branch off at real states.

M. Janner et al., "When to Trust Your Model: Model-Based Policy Optimization", NeurIPS 2019 (arXiv 1906.08253). Settings
and details are those of the authors' program (jannerm/mbpo).

Shapes: n transitions, B networks, D observation entries, F action entries.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from surrogym_lab.peers.methods.elites import Trained, fit
from surrogym_lab.peers.methods.ensemble import Ensemble
from surrogym_lab.peers.methods.model_free import RealEnv
from surrogym_lab.peers.methods.states import States
from surrogym_lab.peers.methods.told import survives
from surrogym_lab.peers.port import Real
from surrogym_trainer.policies.predict import Acting

Floats = NDArray[np.float32]
Acts = Callable[[Floats], Floats]
"""Observations (n, D) to actions (n, F) in [-1, 1]."""
ROUND = 50  # real steps


@dataclass(frozen=True)
class Settings:
    """Settings of MBPO. But for ``epoch``, the defaults are the authors' for the inverted double pendulum, their task
    that is nearest to ours. There an epoch of 500 real steps has two steps, and a training ends after five epochs
    without an improvement: some hundred steps, after which the ensemble has learned next to nothing of Pendulum."""

    networks: int = 7
    elites: int = 5
    hidden: tuple[int, ...] = (200, 200, 200, 200)
    decay: tuple[float, ...] = (2.5e-5, 5e-5, 7.5e-5, 7.5e-5, 1e-4)
    rate: float = 1e-3
    epoch: int = 16  # steps of an epoch, at least: as with 5,000 real steps, the authors' usual first ones
    explore: int = 500  # real steps of random actions; at most half of the budget
    every: int = 250  # real steps between trainings of the ensemble
    rollouts: int = 400  # for each real step between trainings
    length: int = 1  # k, steps of a rollout
    updates: int = 20  # G, of the actor and critics after each real step
    batch: int = 256  # of an update
    real_share: float = 0.05  # of a batch
    target_entropy: float = -0.5


AUTHORS = {"InvertedPendulum-v5": Settings(updates=10, target_entropy=-0.05, epoch=1)}


class Transitions(NamedTuple):
    """Transitions: observations (n, D), actions (n, F) in [-1, 1], rewards (n,), reached observations (n, D), and 1.0
    where the episode ended (n,)."""

    seen: Floats
    action: Floats
    reward: Floats
    reached: Floats
    ended: Floats


class Mbpo:
    """MBPO. It learns the reward, and knows when an episode ends. A discrete action is a number, which is rounded."""

    def __init__(self, settings: Settings | None = None) -> None:
        self._settings = settings
        self._authors = AUTHORS

    def learn(self, real: Real, seed: int) -> Iterator[Acting]:
        """Yield the policy after every 50 real steps (algorithm 2 of the paper)."""
        chosen = self._settings or self._authors.get(real.spec.environment, Settings())
        env, rng = RealEnv(real, boxed=True), np.random.default_rng(seed)
        learner = SAC(*("MlpPolicy", env), seed=seed, device="cpu", buffer_size=1, target_entropy=chosen.target_entropy)
        learner.set_logger(Logger(None, []))
        states = States(real.spec)
        pools = Pools(real.budget, len(real.spec.observation), states.controls, rng, chosen.real_share)
        learner.replay_buffer = pools  # type: ignore[assignment]
        model = Model(states, chosen, rng)
        seen, explore = env.reset()[0], min(chosen.explore, real.budget // 2)

        def acts(observations: Floats) -> Floats:
            with torch.no_grad():
                action: Floats = learner.actor(torch.from_numpy(observations)).numpy()
            return action

        def act(observations: NDArray[np.float32]) -> NDArray[Any]:
            return env.native(np.asarray(learner.predict(observations, deterministic=True)[0]))

        for _ in range(explore):
            seen = _stepped(env, learner, pools, seen, rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
        while True:
            if (step := real.steps - explore) % chosen.every == 0:
                model.train(pools.real, real.clock.check)
                pools.imagined = model.rollouts(pools.real.seen, acts)
            seen = _stepped(env, learner, pools, seen, acts(seen[None])[0])
            learner.train(chosen.updates, chosen.batch)
            if (step + 1) % ROUND == 0:
                yield act


def _stepped(env: RealEnv, learner: SAC, pools: Pools, seen: Floats, action: Floats) -> Floats:
    """Take a real step, keep it, and return the observation that the next one begins at."""
    reached, reward, terminated, truncated, _ = env.step(learner.policy.unscale_action(action))
    pools.add(seen, action, reward, reached, ended=terminated)
    return env.reset()[0] if terminated or truncated else reached


class Pools:
    """Real and imagined transitions. SAC draws its batches from it, as from a replay buffer of its library.

    Args:
        room: largest number of real transitions.
        seen, action: numbers of entries D and F.
        rng: random generator.
        share: of a batch that is real.
    """

    def __init__(self, room: int, seen: int, action: int, rng: np.random.Generator, share: float) -> None:
        self.imagined: Transitions | None = None
        self._rng = rng
        self._share = share
        shapes = ((seen,), (action,), (), (seen,), ())
        self._rows = Transitions(*(np.zeros((room, *shape), np.float32) for shape in shapes))
        self._count = 0

    @property
    def real(self) -> Transitions:
        """All real transitions."""
        return Transitions(*(part[: self._count] for part in self._rows))

    def add(self, seen: Floats, action: Floats, reward: float, reached: Floats, *, ended: bool) -> None:
        """Keep a real transition."""
        rows = self._rows
        rows.seen[self._count], rows.action[self._count], rows.reward[self._count] = seen, action, reward
        rows.reached[self._count], rows.ended[self._count] = reached, ended
        self._count += 1

    def sample(self, batch_size: int, env: Any = None) -> ReplayBufferSamples:
        """Draw transitions with replacement, the real ones first."""
        del env
        assert self.imagined is not None
        count = int(batch_size * self._share)
        first = self._rng.integers(self._count, size=count)
        second = self._rng.integers(len(self.imagined.reward), size=batch_size - count)
        both = zip(self._rows, self.imagined, strict=True)
        seen, action, reward, reached, ended = (
            torch.from_numpy(np.concatenate([one[first], other[second]])) for one, other in both
        )
        return ReplayBufferSamples(seen, action, reached, ended[:, None], reward[:, None])


class Model:
    """The ensemble: from observation and action to reward and change of observation."""

    def __init__(self, states: States, settings: Settings, rng: np.random.Generator) -> None:
        self._states = states
        self._settings = settings
        self._rng = rng
        width = len(states.spec.observation)
        self._ensemble = Ensemble(
            width + states.controls, width + 1, settings.networks, settings.hidden, settings.decay
        )
        self._optimizer = torch.optim.Adam(self._ensemble.parameters(), settings.rate)
        self._trained: Trained | None = None

    def train(self, real: Transitions, check: Callable[[], None]) -> None:
        """Continue the training with all real transitions."""
        y = np.concatenate([real.reward[:, None], real.reached - real.seen], 1)
        x = torch.from_numpy(self._inputs(real.seen, real.action))
        self._trained = fit(
            *(self._ensemble, self._optimizer, x, torch.from_numpy(y)),
            *(self._settings.elites, self._settings.epoch, self._rng, check),
        )

    def rollouts(self, seen: Floats, acts: Acts) -> Transitions:
        """Imagined transitions of a policy, which branch off at random ones of the observations (n, D)."""
        count = self._settings.rollouts * self._settings.every
        at = seen[self._rng.integers(len(seen), size=count)]
        found = []
        for _ in range(self._settings.length):
            action = acts(at)
            reward, reached = self._drawn(at, action)
            ended = 1 - survives(self._states.spec, self._states.coordinates(reached)).astype(np.float32)
            found.append(Transitions(at, action, reward, reached, ended))
            at = reached[ended == 0]
            if not len(at):
                break
        return Transitions(*(np.concatenate(part) for part in zip(*found, strict=True)))

    def _drawn(self, seen: Floats, action: Floats) -> tuple[Floats, Floats]:
        """Rewards (n,) and reached observations (n, D), each drawn from the distribution of a random elite."""
        assert self._trained is not None
        drawn = self._trained.drawn(torch.from_numpy(self._inputs(seen, action))).numpy()
        return drawn[:, 0], seen + drawn[:, 1:]

    def _inputs(self, seen: Floats, action: Floats) -> Floats:
        return np.concatenate([seen, self._states.snapped(action.astype(np.float64))], 1).astype(np.float32)
