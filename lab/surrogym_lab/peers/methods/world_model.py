"""A recurrent world model: a linear controller that CMA-ES finds in the dream of a mixture density network.

D. Ha, J. Schmidhuber, "Recurrent World Models Facilitate Policy Evolution", NeurIPS 2018 (arXiv 1809.01999), with
observations of states where theirs are images. So there is no network that compresses them.

Shapes: P controllers with R rollouts each, n = P R lanes, D observation entries, F action entries, H hidden units.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from cmaes import CMA
from numpy.typing import NDArray
from torch import Tensor

from surrogym_lab.peers.methods.mixture_network import Episode, MixtureNetwork, State, train
from surrogym_lab.peers.methods.states import States
from surrogym_lab.peers.port import Real
from surrogym_sampler.original.episodes import draw
from surrogym_sampler.original.protocol import LONGEST_EPISODE, Array
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.terms import observe
from surrogym_trainer.policies.predict import Acting, PerEpisode

SELECTION = 100  # rollouts of each of the controllers that a search chooses from at its end


@dataclass(frozen=True)
class Settings:
    """Settings of the world model. Those that are smaller than the authors' say so."""

    hidden: int = 64  # the authors: 256, and 512 for their dream
    components: int = 5
    rate: float = 1e-3
    training: int = 500  # gradient steps after each round of real episodes
    collect: int = 100  # real steps of a round, at least; the authors: 10,000 episodes
    longest: int = 200  # steps of an episode, real or imagined
    population: int = 64
    rollouts: int = 4  # of each controller; the authors: 16
    generations: int = 100  # after each round; the authors: up to 2,000
    sigma: float = 0.1
    temperature: float = 1.15


class WorldModel:
    """The iterative training procedure of the paper. The first round acts at random, every other by the controller so
    far. Rewards and ends of episodes are learned. A discrete action is a number, which is rounded."""

    def __init__(self, settings: Settings | None = None) -> None:
        self._settings = settings or Settings()

    def learn(self, real: Real, seed: int) -> Iterator[Acting]:
        """Yield the controller after each round of real episodes, training and search."""
        chosen, states, rng = self._settings, States(real.spec), np.random.default_rng(seed)
        torch.manual_seed(seed)
        width, longest = len(real.spec.observation), min(real.spec.time_limit or LONGEST_EPISODE, chosen.longest)
        model = MixtureNetwork(width, states.controls, chosen.hidden, chosen.components)
        optimizer = torch.optim.Adam(model.parameters(), chosen.rate)
        episodes, best = list[Episode](), np.zeros(states.controls * (width + chosen.hidden + 1))
        dream = Dream(model, states, longest, chosen.temperature)
        act: Acts = Random(states, rng)
        while True:
            end = real.steps + chosen.collect
            while real.steps < end:
                episodes.append(episode(real, states, act, longest))
            train(model, optimizer, episodes, chosen.training, real.clock.check)
            best = search(partial(dream.returns, rng=rng), chosen, best, rng, real.clock.check)
            act = Controlled(dream, best)
            yield act


class Random:
    """Uniform controls."""

    def __init__(self, states: States, rng: np.random.Generator) -> None:
        self._states = states
        self._rng = rng

    def begin(self) -> None:
        pass

    def control(self, seen: Array) -> Array:
        del seen
        return self._rng.uniform(-1, 1, self._states.controls)


class Dream:
    """Episodes of controllers through the network.

    Args:
        model: the network.
        states: how actions are seen.
        longest: steps of an episode.
        temperature: of the draws.
    """

    def __init__(self, model: MixtureNetwork, states: States, longest: int, temperature: float) -> None:
        self.model = model
        self.states = states
        self._longest = longest
        self._temperature = temperature

    def controls(self, theta: Tensor, seen: Tensor, state: State) -> Tensor:
        """Controls (P, R, F) of linear controllers theta (P, F (D + H + 1)) at observations (P R, D) and states."""
        inputs = torch.cat([self.model.scaled(seen), state[0][0], torch.ones(len(seen), 1)], 1)
        lanes = inputs.reshape(len(theta), -1, inputs.shape[1])
        wanted = torch.tanh(lanes @ theta.reshape(len(theta), self.states.controls, -1).mT)
        return torch.from_numpy(self.states.snapped(wanted.double().numpy())).float()

    @torch.no_grad()
    def returns(self, theta: Array, rollouts: int, rng: np.random.Generator) -> Array:
        """Mean returns (P,) of controllers (P, size). All have the same starts and random numbers."""
        count, width = len(theta), len(self.states.spec.observation)
        controllers, state = torch.from_numpy(theta).float(), self.model.start(count * rollouts)
        seen = torch.from_numpy(starts(self.states.spec, rollouts, rng)).float().repeat(count, 1)
        total, alive = torch.zeros(len(seen)), torch.ones(len(seen))
        for _ in range(self._longest):
            uniform, normal = rng.random((rollouts, width + 1)), rng.standard_normal((rollouts, width + 1))
            noise = tuple(torch.from_numpy(part).float().repeat(count, 1) for part in (uniform, normal))
            u = self.controls(controllers, seen, state).flatten(0, 1)
            reward, seen, ended, state = self.model.drawn(seen, u, state, noise, self._temperature)  # type: ignore[arg-type]
            total += alive * reward
            alive *= 1 - ended.float()
            if not alive.any():
                break
        earned: Array = total.reshape(count, rollouts).mean(1).double().numpy()
        return earned


def starts(spec: EnvironmentSpec, count: int, rng: np.random.Generator) -> Array:
    """Observations (R, D) of starts of the task."""
    shown: Array = observe(spec, np.stack([draw(spec, rng, wide=False) for _ in range(count)]))
    return shown


def search(
    returns: Callable[..., Array],
    settings: Settings,
    before: Array,
    rng: np.random.Generator,
    check: Callable[[], None],
) -> Array:
    """Parameters (size,) of the controller with the largest return, by CMA-ES from ``before``, which also competes at
    the end. ``check`` is called in each generation."""
    found = CMA(before, settings.sigma, population_size=settings.population, seed=int(rng.integers(2**31)))
    for _ in range(settings.generations):
        check()
        drawn = np.stack([found.ask() for _ in range(settings.population)])
        scores = returns(drawn, settings.rollouts)
        found.tell([(x, -float(score)) for x, score in zip(drawn, scores, strict=True)])
    candidates = np.stack([before, found.mean])
    best: Array = candidates[np.argmax(returns(candidates, SELECTION))]
    return best


class Controlled(PerEpisode):
    """A controller with the network's memory. Each episode has a state of its own."""

    def __init__(self, dream: Dream, theta: Array) -> None:
        self._dream = dream
        self._theta = torch.from_numpy(theta[None]).float()
        self._states: dict[int, State] = {}

    def begin(self) -> None:
        """Begin a real episode."""
        self._states.clear()

    def control(self, seen: Array) -> Array:
        """Controls (F,) in a real episode at an observation (D,)."""
        chosen: Array = self._controls([0], torch.from_numpy(seen[None]).float())[0]
        return chosen

    def actions(self, episodes: Sequence[int], observations: NDArray[np.float32]) -> NDArray[Any]:
        return self._dream.states.native(self._controls(episodes, torch.from_numpy(observations).float()))

    @torch.no_grad()
    def _controls(self, episodes: Sequence[int], seen: Tensor) -> Array:
        model = self._dream.model
        known = [self._states.get(number) or model.start(1) for number in episodes]
        state = tuple(torch.cat(part, 1) for part in zip(*known, strict=True))
        chosen = self._dream.controls(self._theta, seen, state)[0]  # type: ignore[arg-type]
        _, after = model.memory(torch.cat([model.scaled(seen), chosen], 1)[:, None], state)
        self._states |= {number: (after[0][:, i : i + 1], after[1][:, i : i + 1]) for i, number in enumerate(episodes)}
        controls: Array = chosen.double().numpy()
        return controls


Acts = Random | Controlled


def episode(real: Real, states: States, act: Acts, longest: int) -> Episode:
    """Run one real episode of at most ``longest`` steps."""
    act.begin()
    seen, found, ended = [real.reset().observation], list[tuple[Array, float]](), False
    for _ in range(longest):
        u = states.snapped(act.control(seen[-1])[None])
        moment = real.step(states.native(u)[0])
        found.append((u[0], moment.reward))
        seen.append(moment.observation)
        ended = moment.terminated
        if ended or moment.truncated:
            break
    action, reward = zip(*found, strict=True)
    shown, acted, paid = (torch.from_numpy(np.array(part, np.float32)) for part in (seen, action, reward))
    return Episode(shown, acted, paid, ended)
