"""CMA-ES on the lanes of a session: a small network's parameters, judged by whole virtual episodes.

As Black-DROPS does (Chatzilygeroudis et al., 2017): a policy of few parameters, no gradient, no value function. All
candidates of a generation are stepped together, each from the same starts.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from cmaes import CMA, SepCMA
from numpy.typing import NDArray

from surrogym_client.evaluation.imagined import (
    Imagined,
    imagine,
    imagined_returns,
    observation_statistics,
)
from surrogym_client.original.protocol import LONGEST_EPISODE
from surrogym_client.training.settings import (
    CHECK_EPISODES,
    CHECKS,
    EVOLUTION,
    TrainingInterrupted,
    TrainProgress,
    TrainResult,
    TrainSettings,
)
from surrogym_shared.network import Network
from surrogym_shared.port import SurrogatePort

EVOLUTION_STEPS = 10_000_000
FULL_COVARIANCE = 200  # parameters; beyond, the covariance is diagonal (separable CMA-ES)


@dataclass(frozen=True)
class Evolution:
    """The hyperparameters of CMA-ES here."""

    population: int = 24  # candidates a generation
    starts: int = 16  # episodes a candidate
    units: int = 10  # hidden units of the network
    sigma: float = 1.0  # first deviation of a parameter


def evolve(
    port: SurrogatePort,
    out: Path,
    settings: TrainSettings,
    total_steps: int,
    progress: Callable[[TrainProgress], None] | None = None,
) -> TrainResult:
    """Search a policy by CMA-ES, and save the mean of the distribution whose imagined return was best.

    Args:
        port: the surrogate.
        out: where the policy goes (``Network.save``); beside it, with suffix .json, what it was found with.
        settings: ``hyperparameters`` are the fields of ``Evolution``.
        total_steps: virtual steps, at least one generation's.
        progress: called after every generation.

    Raises:
        ValueError: an unknown or impossible hyperparameter, or a file to go on from that is no network of this size.
        SurrogymClientError: the surrogate can't be reached, or has no model yet.
        TrainingInterrupted: Ctrl-C came; the best so far is saved.
    """
    search = _Search(port, settings, _evolution(settings))
    started, spec = time.perf_counter(), port.spec()
    cost = search.choices.population * search.choices.starts * (spec.time_limit or LONGEST_EPISODE)
    generations = max(total_steps // cost, 1)
    best, kept, latest, done, penalty = -np.inf, None, None, 0, None
    with suppress(KeyboardInterrupt):
        for number in range(1, generations + 1):
            seen = search.generation(number)
            done, penalty = number, seen.episode_penalty
            if number * CHECKS // generations > (number - 1) * CHECKS // generations:
                latest = search.imagined()
                if latest >= best:
                    best, kept = latest, search.policy
            if progress is not None:
                progress(TrainProgress(number * cost, generations * cost, latest, seen.penalty_share, penalty))
    kept = kept or search.policy
    out.parent.mkdir(parents=True, exist_ok=True)
    kept.save(out)
    result = TrainResult(
        path=out,
        algorithm=EVOLUTION,
        virtual_steps=done * cost,
        seconds=time.perf_counter() - started,
        imagined_return=None if latest is None else best,
        episode_penalty=penalty,
        lost_episodes=0,
        settings={**asdict(settings), **asdict(search.choices), "total_steps": generations * cost},
    )
    out.with_suffix(".json").write_text(json.dumps(asdict(result), indent=2, default=str) + "\n")
    if done < generations:
        raise TrainingInterrupted(result)
    return result


class _Search:
    """The distribution of parameters, and the episodes that judge it."""

    def __init__(self, port: SurrogatePort, settings: TrainSettings, choices: Evolution) -> None:
        self.choices = choices
        self._port, self._settings, self._spec = port, settings, port.spec()
        mean, deviation = observation_statistics(port, settings.seed)
        self._mean, self._deviation = np.array(mean), np.array(deviation)
        size = Network.size(self._spec, choices.units)
        kind = CMA if size <= FULL_COVARIANCE else SepCMA
        self._cma = kind(_first(settings, size), choices.sigma, population_size=choices.population, seed=settings.seed)

    @property
    def policy(self) -> Network:
        """The network at the mean of the distribution."""
        return self._network(np.array(self._cma.mean))

    def generation(self, number: int) -> Imagined:
        """Draw a population, let each candidate run from the same starts, and learn from their mean returns."""
        choices = self.choices
        drawn = [self._cma.ask() for _ in range(choices.population)]
        everyone = self._network(np.stack(drawn))

        def predict(observation: NDArray[Any]) -> NDArray[Any]:
            actions = everyone(observation.reshape(choices.population, choices.starts, -1))
            return actions.reshape(len(observation), *actions.shape[2:])

        lanes = choices.population * choices.starts
        starts = np.random.default_rng([self._settings.seed, number]).integers(2**62, size=choices.starts)
        seeds = [int(seed) for seed in np.tile(starts, choices.population)]
        seen = imagine(self._port, predict, lanes, seeds, **self._settings.session)
        scores = seen.returns.reshape(choices.population, choices.starts).mean(1)
        self._cma.tell([(x, -float(score)) for x, score in zip(drawn, scores, strict=True)])
        return seen

    def imagined(self) -> float:
        """Imagined return of the mean."""
        settings = self._settings
        returns = imagined_returns(self._port, self.policy, CHECK_EPISODES, settings.seed, **settings.judging)
        return float(returns.mean())

    def _network(self, vector: NDArray[np.float64]) -> Network:
        return Network.of(self._spec, self._mean, self._deviation, self.choices.units, vector)


def _evolution(settings: TrainSettings) -> Evolution:
    try:
        return Evolution(**settings.hyperparameters)
    except TypeError as error:
        names = ", ".join(Evolution.__dataclass_fields__)
        raise ValueError(f"{EVOLUTION} takes {names}, got {', '.join(settings.hyperparameters)}") from error


def _first(settings: TrainSettings, size: int) -> NDArray[np.float64]:
    if settings.start_from is None:
        return np.zeros(size)
    vector = Network.load(settings.start_from).vector
    if len(vector) != size:
        raise ValueError(f"{settings.start_from}: expected a network of {size} parameters, got {len(vector)}")
    return vector
