"""Measurements: confidence and error of every model of a design, and real episodes under varied conditions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_client.transport.api import Api
from surrogym_lab.reproduce.paper_cases import ANYWHERE, Variation
from surrogym_sampler.original import OriginalEnvironment, make
from surrogym_sampler.original.episode import Moment
from surrogym_sampler.original.episodes import GymnasiumEpisode, draw
from surrogym_sampler.original.protocol import RealStep
from surrogym_sampler.original.simulator import SMALLEST_FACTOR
from surrogym_shared.spec import BoxAction, EnvironmentSpec
from surrogym_shared.terms import observe
from surrogym_shared.wire import ModelView
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, Trace, evaluate
from surrogym_trainer.policies.predict import Predict

Array = NDArray[np.float64]

UNSEEN_SEED = 20_000
PENALTY = 3.0  # k of eq. 14


class BiasedEpisode(GymnasiumEpisode):
    """An episode that starts as a variation says, with changed physical quantities."""

    def __init__(self, spec: EnvironmentSpec, variation: Variation) -> None:
        super().__init__(spec)
        self._variation = variation
        self._gain = 1.0
        self._nominal = {name: getattr(self._env, name) for name in variation.physics}

    def reset(self, seed: int) -> Moment:
        """Factors and start are drawn from the seed; where the variation names no start, it is the environment's."""
        rng = np.random.default_rng(seed)
        for name in self._variation.physics:
            factor = _factor(rng, self._variation)
            setattr(self._env, name, self._nominal[name] * factor)
            if name == self._variation.limit:
                self._gain = factor
        if self._task.settle is not None:
            self._task.settle(self._env)
        if self._variation.start is None:
            return super().reset(seed)
        return self.place(draw(self.spec, rng, wide=self._variation.start == ANYWHERE))

    def step(self, action: Array) -> Moment:
        return super().step(action if self._gain == 1.0 else self._gain * action)


def _factor(rng: np.random.Generator, variation: Variation) -> float:
    off = variation.sigma * float(rng.standard_normal())
    return max(SMALLEST_FACTOR, 1.0 + (abs(off) if variation.upward else off))


def run_variation(predict: Predict, spec: EnvironmentSpec, variation: Variation) -> dict[str, Any]:
    """Real episodes of one kind, from reset seed 10000 on, JSON-able: returns, lengths, successes, starts, traces."""
    if isinstance(variation.start, dict):
        spec = spec.model_copy(update={"start": variation.start})
    every = EvaluationSettings(episodes=1 if variation.traced else variation.episodes)
    shifts = range(variation.episodes if variation.traced else 1)
    parts = [replace(every, first_seed=every.first_seed + shift) for shift in shifts]
    results = [evaluate(predict, lambda: BiasedEpisode(spec, variation), part) for part in parts]
    return {
        "returns": [float(r) for result in results for r in result.returns],
        "lengths": [int(n) for result in results for n in result.lengths],
        "success": [bool(s) for result in results if result.success is not None for s in result.success],
        "starts": _starts(spec, variation, every.first_seed),
        "traces": [_trace(result.trace) for result in results] if variation.traced else [],
        "steps": sum(result.steps for result in results),
    }


def _starts(spec: EnvironmentSpec, variation: Variation, first_seed: int) -> list[list[float]]:
    """Starts of the episodes that start anywhere under nominal physics."""
    if variation.start != ANYWHERE or variation.physics:
        return []
    seeds = range(first_seed, first_seed + variation.episodes)
    return [draw(spec, np.random.default_rng(seed), wide=True).tolist() for seed in seeds]


def _trace(trace: Trace) -> dict[str, Any]:
    return {"coordinates": trace.coordinates.tolist(), "reward": trace.reward.tolist()}


class Unseen:
    """Real steps from anywhere that no design has seen, to test models."""

    def __init__(self, spec: EnvironmentSpec, count: int) -> None:
        self._spec = spec
        rng = np.random.default_rng(UNSEEN_SEED)
        coordinates = [draw(spec, rng, wide=True) for _ in range(count)]
        actions = [_random_action(spec, rng) for _ in range(count)]
        environment = make(spec.environment, spec=spec)
        assert isinstance(environment, OriginalEnvironment)
        try:
            steps = [environment.step_from(q, u) for q, u in zip(coordinates, actions, strict=True)]
        finally:
            environment.close()
        self.coordinates = _rows([s.coordinates for s in steps])
        self.action = _rows([s.action for s in steps])
        self.reward = np.array([s.reward for s in steps])
        self._arrived = self._observed(steps)

    def _observed(self, steps: Sequence[RealStep]) -> Array:
        """Real next observations (n, D)."""
        arrived: Array = observe(self._spec, np.array(_rows([s.next_coordinates for s in steps])))
        return arrived

    def errors(self, api: Api, name: str, model: ModelView) -> dict[str, Any]:
        """Root mean square errors of one model, and its reward at every point.

        ``state`` is the largest over observation entries, as a share of each entry's deviation over one step.
        """
        said = api.predict(name, self.coordinates, self.action, model=model.version)
        observed = np.array(said.next_observation)
        before = observe(self._spec, np.array(self.coordinates))
        spread = (self._arrived - before).std(0)
        state = np.sqrt(np.square(observed - self._arrived).mean(0)) / np.where(spread > 0, spread, 1.0)
        reward = np.array(said.reward)
        return {
            "samples": model.samples,
            "reward": float(np.sqrt(np.square(reward - self.reward).mean())),
            "state": float(state.max()),
            "mean": reward.tolist(),
            "lower": (reward - PENALTY * np.array(said.reward_deviation)).tolist(),
        }


def confidences(models: Sequence[ModelView]) -> list[dict[str, Any]]:
    """Confidence index of every model of a design: of the reward, the smallest, and both as printed."""
    rows = []
    for model in models:
        reward = model.fidelity.outputs[-1]
        rows.append(
            {
                "samples": model.samples,
                "reward": reward.confidence_index,
                "smallest": model.fidelity.confidence_index,
                "reward_printed": reward.confidence_index_paper,
                "smallest_printed": model.fidelity.confidence_index_paper,
            }
        )
    return rows


def some(models: Sequence[ModelView], count: int) -> list[ModelView]:
    """The first model, the last, and others evenly between, at most ``count``."""
    chosen = np.unique(np.linspace(0, len(models) - 1, min(count, len(models))).round().astype(int))
    return [models[i] for i in chosen]


def _random_action(spec: EnvironmentSpec, rng: np.random.Generator) -> Array:
    if isinstance(spec.action, BoxAction):
        return rng.uniform(spec.action.low, spec.action.high)
    return rng.integers(0, spec.action.nvec).astype(np.float64)


def _rows(values: Sequence[Any]) -> list[list[float]]:
    return [np.atleast_1d(np.asarray(v, dtype=np.float64)).tolist() for v in values]
