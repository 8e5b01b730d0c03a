"""Black-DROPS: policy search by CMA-ES on returns of sampled rollouts through Gaussian processes.

K. Chatzilygeroudis et al., "Black-Box Data-efficient Policy Search for Robotics", IROS 2017 (arXiv 1703.07261).

Shapes: R rollouts of each of P policies, C coordinates, A features, F controls, H hidden units.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
import torch
from cmaes import CMA
from torch import Tensor

from surrogym_lab.peers.methods.gaussian_process import fit
from surrogym_lab.peers.methods.states import Held, States, Transitions, episode, random_control
from surrogym_lab.peers.methods.told import Told, survives, told
from surrogym_lab.peers.port import Real
from surrogym_sampler.original.episodes import draw
from surrogym_sampler.original.protocol import Array
from surrogym_trainer.policies.predict import Acting

BOUND = 5.0  # of the policy's parameters
PAST = 1.5  # ranges of data that rollouts may leave them by, before they stay where they are


@dataclass(frozen=True)
class Settings:
    """Settings of Black-DROPS: those of the authors' pendulum, but for ``rollouts`` and ``signal_to_noise``."""

    hidden: int = 10
    evaluations: int = 10_000  # of policies, for each search; the authors' cart-pole has 40,000
    restarts: int = 5
    sigma: float = 1.0  # a fifth of the bounds
    rollouts: int = 5  # of each policy; the authors take one, and a CMA-ES that handles uncertainty
    signal_to_noise: float = 500.0  # limit of the processes' hyperparameters; the authors have none


class BlackDrops:
    """Black-DROPS with a network of one hidden layer. The first episode acts at random, every other by the policy so
    far."""

    def __init__(self, settings: Settings | None = None) -> None:
        self._settings = settings or Settings()

    def learn(self, real: Real, seed: int) -> Iterator[Acting]:
        """Yield the policy after each episode and its search (algorithm 1 of the paper)."""
        states, rng, known = States(real.spec), np.random.default_rng(seed), told(real.spec)
        control, data = random_control(states, rng), list[Transitions]()
        best: Array | None = None
        while True:
            data.append(episode(real, states, control, known.horizon, known.repeat))
            seen = Transitions.joined(data)
            inputs = np.concatenate([states.featured(seen.q), seen.u], 1)
            model = self.model(inputs, states.change(seen.q, seen.reached), rng, real.clock.check)
            limits = np.abs(states.featured(np.concatenate([seen.q, seen.reached]))).max(0) + 1e-6
            imagined = Imagined(states, known, model, seen, limits, self._settings)
            best = search(
                partial(imagined.returns, rng=rng), self._settings, imagined.size, rng, best, real.clock.check
            )
            control = partial(_act, imagined, best)
            yield Held(states, control, known.repeat)

    def model(self, x: Array, y: Array, rng: np.random.Generator, check: Callable[[], None]) -> Model:
        """Model of outputs (n, C) at inputs (n, A + F) of n samples."""
        return fit(x, y, self._settings.signal_to_noise, rng, check)


class Model(Protocol):
    """What a rollout needs of a model."""

    def predict(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Means and standard deviations (m, C) at inputs (m, A + F)."""
        ...


class Imagined:
    """Rollouts of policies through the processes."""

    def __init__(
        self, states: States, known: Told, model: Model, seen: Transitions, limits: Array, settings: Settings
    ) -> None:
        self.states = states
        self.limits = limits  # (A,), by which features are divided for the policy
        self._known = known
        self._model = model
        self._rollouts = settings.rollouts
        self._hidden = settings.hidden
        both = np.concatenate([seen.q, seen.reached])
        middle, half = (both.max(0) + both.min(0)) / 2, (both.max(0) - both.min(0)) / 2
        free = self.states.angles
        self._low = np.where(free, -np.inf, middle - PAST * 2 * half)
        self._high = np.where(free, np.inf, middle + PAST * 2 * half)

    @property
    def size(self) -> int:
        """Number of parameters of a policy."""
        features, controls = self.states.features, self.states.controls
        return self._hidden * (features + 1) + controls * (self._hidden + 1)

    def controls(self, theta: Array, q: Array) -> Array:
        """Controls (P, R, F) of policies (P, size) at coordinates (P, R, C)."""
        count, width, hidden, out = len(theta), self.states.features, self._hidden, self.states.controls
        x = self.states.featured(q.reshape(-1, q.shape[-1])).reshape(*q.shape[:2], width) / self.limits
        first, bias, second, last = np.split(theta, np.cumsum([hidden * width, hidden, out * hidden]), axis=1)
        inner = np.tanh(x @ first.reshape(count, width, hidden) + bias[:, None])
        outer: Array = np.tanh(inner @ second.reshape(count, hidden, out) + last[:, None])
        return outer

    def returns(self, theta: Array, rng: np.random.Generator, rollouts: int | None = None) -> Array:
        """Mean returns (P,) of policies (P, size). All have the same starts and random numbers.

        Each step is drawn from the processes' distribution there (equation 10 of the paper)."""
        policies, each = len(theta), rollouts or self._rollouts
        starts = np.stack([draw(self.states.spec, rng, wide=False) for _ in range(each)])
        q = np.tile(starts, (policies, 1))  # (P * R, C)
        total, alive = np.zeros(len(q)), np.arange(len(q))
        for noise in rng.standard_normal((self._known.horizon, *starts.shape)):
            u = self.states.snapped(self.controls(theta, q.reshape(policies, each, -1)))
            before, acting = q[alive], u.reshape(len(q), -1)[alive]
            reached = self._drawn(before, acting, np.tile(noise, (policies, 1))[alive])
            total[alive] += self._known.reward(before, acting, reached)
            q[alive] = reached
            alive = alive[survives(self.states.spec, reached) > 0]
            if not len(alive):
                break
        earned: Array = total.reshape(policies, each).mean(1)
        return earned

    def _drawn(self, q: Array, u: Array, noise: Array) -> Array:
        inputs = torch.from_numpy(np.concatenate([self.states.featured(q), u], 1))
        mean, deviation = (part.numpy() for part in self._model.predict(inputs))
        drawn: Array = np.clip(q + mean + deviation * noise, self._low, self._high)
        return drawn


def search(
    returns: Callable[..., Array],
    settings: Settings,
    size: int,
    rng: np.random.Generator,
    before: Array | None,
    check: Callable[[], None],
) -> Array:
    """Parameters (size,) with the largest return, by CMA-ES with a growing population at each restart.

    Args:
        returns: returns (P,) of parameters (P, size).
        settings: limits of the search.
        size: number of parameters.
        rng: random generator.
        before: parameters to begin with, which also compete at the end.
        check: called in each generation.
    """
    spent, kept = 0, [np.zeros(size) if before is None else before]
    population = 4 + int(3 * np.log(size))
    while spent < settings.evaluations and len(kept) <= settings.restarts + 1:
        start = kept[0] if len(kept) == 1 else rng.uniform(-1, 1, size)
        limits = np.tile([-BOUND, BOUND], (size, 1))
        found = CMA(start, settings.sigma, bounds=limits, population_size=population, seed=int(rng.integers(2**31)))
        while spent < settings.evaluations and not found.should_stop():
            check()
            drawn = np.stack([found.ask() for _ in range(population)])
            scores = returns(drawn)
            found.tell([(x, -float(score)) for x, score in zip(drawn, scores, strict=True)])
            spent += population
        kept.append(np.clip(found.mean, -BOUND, BOUND))
        population *= 2
    candidates = np.stack(kept)
    best: Array = candidates[np.argmax(returns(candidates, rollouts=50))]
    return best


def _act(imagined: Imagined, theta: Array, q: Array) -> Array:
    chosen: Array = imagined.controls(theta[None], q[None])[0]
    return chosen
