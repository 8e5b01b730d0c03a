"""PETS: planning by the cross-entropy method through a probabilistic ensemble, with trajectory sampling.

K. Chua et al., "Deep Reinforcement Learning in a Handful of Trials using Probabilistic Dynamics Models", NeurIPS 2018.

Shapes: N states, L candidates, P particles, T controls of a plan, C coordinates, F entries of a control.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_lab.peers.methods.ensemble import Ensemble, train
from surrogym_lab.peers.methods.states import Control, States, Transitions, episode, random_control
from surrogym_lab.peers.methods.told import Told, survives, told
from surrogym_lab.peers.port import Clock, Real
from surrogym_sampler.original.protocol import Array
from surrogym_trainer.policies.predict import Acting, PerEpisode


@dataclass(frozen=True)
class Settings:
    """Settings of PETS. The defaults fit one core; ``AUTHORS`` has those of the authors' cart-pole."""

    networks: int = 5
    hidden: tuple[int, ...] = (64, 64, 64)
    decay: tuple[float, ...] = (1e-4, 2.5e-4, 2.5e-4, 5e-4)
    rate: float = 1e-3
    epochs: int = 50  # after each episode
    batch: int = 32
    particles: int = 10
    horizon: int = 20
    population: int = 100
    elites: int = 10
    iterations: int = 3
    smoothing: float = 0.1  # alpha
    decisions: int = 200  # of an episode


AUTHORS = Settings(hidden=(500, 500, 500), epochs=5, particles=20, horizon=25, population=400, elites=40, iterations=5)


class Pets:
    """PETS with TS-infinity. The first episode acts at random, every other plans."""

    def __init__(self, settings: Settings | None = None) -> None:
        self._settings = settings or Settings()

    def learn(self, real: Real, seed: int) -> Iterator[Acting]:
        """Yield the planner after each episode and the training that follows (algorithm 1 of the paper)."""
        chosen, states, known = self._settings, States(real.spec), told(real.spec)
        rng = np.random.default_rng(seed)
        torch.manual_seed(seed)
        size = len(states.angles)
        model = Ensemble(states.features + states.controls, size, chosen.networks, chosen.hidden, chosen.decay)
        optimizer = torch.optim.Adam(model.parameters(), chosen.rate)
        control, data = random_control(states, rng), list[Transitions]()
        while True:
            data.append(episode(real, states, control, chosen.decisions, known.repeat))
            seen = Transitions.joined(data)
            inputs = np.concatenate([states.featured(seen.q), seen.u], 1)
            x, y = (torch.from_numpy(part).float() for part in (inputs, states.change(seen.q, seen.reached)))
            train(model, optimizer, x, y, chosen.epochs, chosen.batch, real.clock.check)
            planner = Planner(states, known, model, chosen, rng)
            control = _one_episode(planner, real.clock)
            yield Planning(planner, known.repeat)


class Planner:
    """Plans of controls through an ensemble."""

    def __init__(
        self, states: States, known: Told, model: Ensemble, settings: Settings, rng: np.random.Generator
    ) -> None:
        self.states = states
        self._known = known
        self._model = model
        self._settings = settings
        self._rng = rng

    def begin(self) -> Array:
        """The plan (T, F) before the first step of an episode."""
        return np.zeros((self._settings.horizon, self.states.controls))

    def plan(self, q: Array, before: Array) -> Array:
        """Plan (T, F) from coordinates (C,). It begins the search at an earlier plan (T, F)."""
        chosen = self._settings
        return cross_entropy(
            lambda plans: self.returns(q, plans),
            before,
            population=chosen.population,
            elites=chosen.elites,
            iterations=chosen.iterations,
            smoothing=chosen.smoothing,
            rng=self._rng,
        )

    def returns(self, q: Array, plans: Array) -> Array:
        """Mean returns (L,) of plans (L, T, F) over particles that begin at q (C,).

        Each particle keeps its network (TS-infinity), and draws from its distribution (section 5 of the paper).
        """
        count, networks, particles = len(plans), self._settings.networks, self._settings.particles
        at = np.tile(q, (networks, count * (particles // networks), 1))  # a network's candidates, each repeated
        total, alive = np.zeros(at.shape[:2]), np.ones(at.shape[:2])
        for step in range(plans.shape[1]):
            u = np.tile(self.states.snapped(np.repeat(plans[:, step], particles // networks, 0)), (networks, 1, 1))
            reached = self._drawn(at, u)
            flat = (part.reshape(-1, part.shape[-1]) for part in (at, u, reached))
            total += alive * self._known.reward(*flat).reshape(total.shape)
            alive *= survives(self.states.spec, reached.reshape(-1, len(q))).reshape(total.shape)
            at = reached
        earned: Array = total.reshape(networks, count, -1).mean((0, 2))
        return earned

    @torch.no_grad()
    def _drawn(self, q: Array, u: Array) -> Array:
        featured = self.states.featured(q.reshape(-1, q.shape[-1])).reshape(*q.shape[:2], -1)
        mean, log_variance = self._model(torch.from_numpy(np.concatenate([featured, u], -1)).float())
        change = mean + torch.exp(log_variance / 2) * torch.randn_like(mean)
        drawn: Array = q + change.numpy()
        return drawn


def cross_entropy(
    returns: Callable[[Array], Array],
    mean: Array,
    *,
    population: int,
    elites: int,
    iterations: int,
    smoothing: float,
    rng: np.random.Generator,
) -> Array:
    """The mean (T, F) of plans in [-1, 1] after a search by the cross-entropy method.

    Args:
        returns: returns (L,) of plans (L, T, F).
        mean: of the first plans.
        population, elites, iterations: numbers of plans, of those that are kept, and of rounds.
        smoothing: share of the old mean and variance that stays.
        rng: random generator.
    """
    variance = np.full_like(mean, 0.25)  # a sixteenth of the squared range
    for _ in range(iterations):
        room = np.minimum((mean + 1) / 2, (1 - mean) / 2) ** 2  # of the authors' truncated normal distribution
        deviation = np.sqrt(np.minimum(variance, room))
        noise = np.clip(rng.standard_normal((population, *mean.shape)), -2, 2)
        plans = mean + deviation * noise
        best = plans[np.argsort(-returns(plans), kind="stable")[:elites]]
        mean = smoothing * mean + (1 - smoothing) * best.mean(0)
        variance = smoothing * variance + (1 - smoothing) * best.var(0)
    return mean


def _shifted(plan: Array) -> Array:
    """The plan one control later, with no control at its end."""
    return np.concatenate([plan[1:], np.zeros_like(plan[:1])])


def _one_episode(planner: Planner, clock: Clock) -> Control:
    """A control for one real episode, which begins each plan at the last one."""
    plan = planner.begin()

    def control(q: Array) -> Array:
        nonlocal plan
        clock.check()
        found = planner.plan(q[0], plan)
        plan = _shifted(found)
        return found[:1]

    return control


class Planning(PerEpisode):
    """A planner for evaluations. Each episode has its own plan."""

    def __init__(self, planner: Planner, repeat: int) -> None:
        self._planner = planner
        self._repeat = repeat
        self._plans: dict[int, Array] = {}
        self._steps: dict[int, int] = {}
        self._held: dict[int, Array] = {}

    def actions(self, episodes: Sequence[int], observations: NDArray[np.float32]) -> NDArray[Any]:
        states = self._planner.states
        for number, q in zip(episodes, states.coordinates(observations), strict=True):
            step = self._steps.get(number, 0)
            self._steps[number] = step + 1
            if step % self._repeat == 0:
                found = self._planner.plan(q, self._plans.get(number, self._planner.begin()))
                self._plans[number] = _shifted(found)
                self._held[number] = states.native(found[:1])[0]
        return np.stack([self._held[number] for number in episodes])
