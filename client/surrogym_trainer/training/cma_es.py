"""CMA-ES in the virtual environment: a search over the parameters of a small network by the returns of virtual
episodes.

This is the approach of Black-DROPS (Chatzilygeroudis et al., 2017): a policy of few parameters, no gradient, no value
function. All candidates of a generation are stepped together, each from the same starts.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from cmaes import CMA, SepCMA
from numpy.typing import NDArray

from surrogym_sampler.original.protocol import LONGEST_EPISODE
from surrogym_shared.network import Network
from surrogym_shared.port import SurrogatePort
from surrogym_trainer.evaluation.imagined import STATISTICS_LANES, Imagined, imagine, observation_statistics
from surrogym_trainer.training.checks import checked
from surrogym_trainer.training.search import Found, PolicySearch, SearchTask
from surrogym_trainer.training.settings import CHECKS, TrainProgress, TrainSettings

# largest number of parameters with a full covariance; with more, it is diagonal (separable CMA-ES)
FULL_COVARIANCE = 200
SMALLEST = 1e-6  # an entry of observations with a smaller standard deviation is not scaled


@dataclass(frozen=True)
class CmaEs(PolicySearch):
    """Policy search by CMA-ES over the parameters of a network. The result is the mean of the distribution in
    the generation in which the mean has the best imagined return.

    A linear policy (``units=0``) standardises observations by all that its candidates saw so far, as H. Mania et al. do
    ("Simple random search", 2018). Any other policy standardises them by the sampling range.
    """

    population: int = 24  # number of candidates in each generation
    starts: int = 16  # number of episodes of each candidate
    units: int = 10  # number of hidden units of the network; 0 for a policy without a hidden layer
    sigma: float = 1.0  # initial standard deviation of a parameter

    suggested_steps = 10_000_000
    saves_network = True
    most_steps = None  # no limit: CMA-ES takes far more steps than PPO, but each is far cheaper

    def search(self, task: SearchTask) -> Found:
        run = _Run(task, self)
        stopped = None
        try:
            for number in range(1, run.generations + 1):
                run.generation(number)
        except (KeyboardInterrupt, Exception) as error:
            stopped = error
        return run.found(stopped)


class _Run:
    """The generations of one search, and the best mean of the distribution so far."""

    def __init__(self, task: SearchTask, choices: CmaEs) -> None:
        self._task, self._choices = task, choices
        self._distribution = _Distribution(task.port, task.settings, choices)
        limit = task.port.spec().time_limit or LONGEST_EPISODE
        self._cost = choices.population * choices.starts * limit  # number of virtual steps in a generation
        self.generations = max(task.steps // self._cost, 1)
        self._done = 0
        self._kept: Network | None = None
        self._best = -np.inf
        self._latest: float | None = None
        self._penalty: float | None = None

    def generation(self, number: int) -> None:
        """Run one generation. In ``CHECKS`` of all generations, evenly spread, the mean is evaluated."""
        seen = self._distribution.generation(number)
        self._done, self._penalty = number, seen.episode_penalty
        if number * CHECKS // self.generations > (number - 1) * CHECKS // self.generations:
            self._check()
        steps, total = number * self._cost, self.generations * self._cost
        self._task.progress(TrainProgress(steps, total, self._latest, seen.penalty_share, self._penalty))

    def found(self, stopped: BaseException | None) -> Found:
        """Return the best mean of the generations so far. ``stopped`` is Ctrl-C or an error that ended them."""
        return Found(
            self._kept or self._distribution.policy,
            self._done * self._cost,
            None if self._latest is None else self._best,
            {**asdict(self._choices), "total_steps": self.generations * self._cost},
            whole=self._done == self.generations,
            stopped=stopped,
            episode_penalty=self._penalty,
        )

    def _check(self) -> None:
        self._latest = self._distribution.imagined()
        if self._latest >= self._best:
            self._best, self._kept = self._latest, self._distribution.policy


class _Distribution:
    """The distribution of the network's parameters, and the virtual episodes that evaluate them."""

    def __init__(self, port: SurrogatePort, settings: TrainSettings, choices: CmaEs) -> None:
        self.choices = choices
        self._port, self._settings, self._spec = port, settings, port.spec()
        mean, deviation = map(np.array, observation_statistics(port, settings.seed))
        size = Network.size(self._spec, choices.units)
        first, self._scale = np.zeros(size), np.ones(size)
        if choices.units == 0:  # a bias changes the outputs no more than a weight does
            self._scale[len(mean) * (size // (len(mean) + 1)) :] /= np.sqrt(len(mean))
        if settings.start_from is not None:
            start = _loaded(settings.start_from, size)
            mean, deviation, first = start.mean, start.deviation, start.vector / self._scale
        self._seen = _Statistics(STATISTICS_LANES, mean, deviation)
        kind = CMA if size <= FULL_COVARIANCE else SepCMA
        self._cma = kind(first, choices.sigma, population_size=choices.population, seed=settings.seed)

    @property
    def policy(self) -> Network:
        """The network at the mean of the distribution."""
        return self._network(np.array(self._cma.mean))

    def generation(self, number: int) -> Imagined:
        """Draw a population, run each candidate from the same starts, and update the distribution by their mean
        returns."""
        choices = self.choices
        drawn = [self._cma.ask() for _ in range(choices.population)]
        everyone = self._network(np.stack(drawn))
        visited: list[NDArray[Any]] = []

        def predict(observation: NDArray[Any]) -> NDArray[Any]:
            if choices.units == 0:
                visited.append(observation)
            actions = everyone(observation.reshape(choices.population, choices.starts, -1))
            return actions.reshape(len(observation), *actions.shape[2:])

        lanes = choices.population * choices.starts
        starts = np.random.default_rng([self._settings.seed, number]).integers(2**62, size=choices.starts)
        seeds = [int(seed) for seed in np.tile(starts, choices.population)]
        seen = imagine(self._port, predict, lanes, seeds, **self._settings.session)
        if visited:
            self._seen = self._seen.with_all(np.concatenate(visited))
        scores = seen.returns.reshape(choices.population, choices.starts).mean(1)
        self._cma.tell([(x, -float(score)) for x, score in zip(drawn, scores, strict=True)])
        return seen

    def imagined(self) -> float:
        """Return the imagined return of the network at the mean."""
        return float(checked(self._port, self.policy, self._settings).mean())

    def _network(self, vector: NDArray[np.float64]) -> Network:
        return Network.of(self._spec, self._seen.mean, self._seen.deviation, self.choices.units, vector * self._scale)


@dataclass(frozen=True)
class _Statistics:
    """Mean (D,) and standard deviation (D,) of each of D entries over ``count`` observations."""

    count: int
    mean: NDArray[np.float64]
    deviation: NDArray[np.float64]

    def with_all(self, more: NDArray[Any]) -> _Statistics:
        """Return the statistics with more observations (N, D)."""
        share, off = len(more) / (self.count + len(more)), more.mean(0) - self.mean
        square = (1 - share) * self.deviation**2 + share * more.var(0) + share * (1 - share) * off**2
        deviation = np.where(square > SMALLEST**2, np.sqrt(square), 1.0)
        return _Statistics(self.count + len(more), self.mean + share * off, deviation)


def _loaded(path: Path, size: int) -> Network:
    """Return a saved network, which has ``size`` parameters."""
    network = Network.load(path)
    if len(network.vector) != size:
        raise ValueError(
            f"{path}: expected a network with {size} parameters, as this training has, got {len(network.vector)}: "
            "start without it"
        )
    return network
