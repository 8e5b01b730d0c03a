"""A policy search of one's own: the cross-entropy method over the parameters of a small network."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from surrogym_shared.network import Network
from surrogym_trainer.evaluation import imagined_returns, observation_statistics
from surrogym_trainer.training import TrainProgress
from surrogym_trainer.training.search import Found, PolicySearch, SearchTask


@dataclass(frozen=True)
class CrossEntropy(PolicySearch):
    """Draw candidates from a normal distribution, and fit it to the best of them (Rubinstein, 1999).

    Args:
        population: candidates of a generation.
        elite: how many of them the next generation is drawn around.
        starts: episodes of each candidate.
        units: hidden units of the network.
        spread: first standard deviation of each parameter.
        floor: standard deviation that is added in every generation, so that the search does not stop too early.
    """

    population: int = 48
    elite: int = 6
    starts: int = 4
    units: int = 4
    spread: float = 1.0
    floor: float = 0.1

    suggested_steps = 2_000_000

    def search(self, task: SearchTask) -> Found:
        rng, spec = np.random.default_rng(task.settings.seed), task.port.spec()
        mean, deviation = map(np.array, observation_statistics(task.port, task.settings.seed))
        centre = self.start(task, Network.size(spec, self.units))
        spread = np.full_like(centre, self.spread)
        cost = self.population * self.starts * (spec.time_limit or 1_000)
        generations = max(task.steps // cost, 1)
        done, best = 0, None
        try:
            for done in range(1, generations + 1):
                drawn = centre + spread * rng.normal(size=(self.population, len(centre)))
                candidates = Network.of(spec, mean, deviation, self.units, drawn)
                earned = self.returns(task, candidates, seed=done)
                chosen = drawn[np.argsort(earned)[-self.elite :]]
                centre, spread = chosen.mean(0), chosen.std(0) + self.floor * self.spread
                best = float(np.sort(earned)[-self.elite :].mean())
                task.progress(TrainProgress(done * cost, generations * cost, best, 0.0))
        except KeyboardInterrupt:
            pass  # what has been found so far is given back
        policy = Network.of(spec, mean, deviation, self.units, centre)
        return Found(policy, done * cost, best, asdict(self), whole=done == generations)

    def start(self, task: SearchTask, size: int) -> Any:
        """The first centre (size,): that of the policy to start from, if there is one."""
        if task.settings.start_from is None:
            return np.zeros(size)
        vector = Network.load(task.settings.start_from).vector
        if len(vector) != size:
            raise ValueError(f"{task.settings.start_from}: expected a network of {size} parameters, got {len(vector)}")
        return vector

    def returns(self, task: SearchTask, candidates: Network, seed: int) -> Any:
        """Mean imagined return (population,) of each candidate, all from the same starts."""
        shape = self.population, self.starts

        def predict(observation: Any) -> Any:
            actions = candidates(observation.reshape(*shape, -1))
            return actions.reshape(len(observation), *actions.shape[2:])

        seeds = [int(start) for start in np.tile(np.arange(self.starts) + seed * self.starts, self.population)]
        returns = imagined_returns(task.port, predict, len(seeds), seeds, **task.settings.session)
        return returns.reshape(shape).mean(1)
