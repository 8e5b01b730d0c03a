"""Noise of the sensors is told from noise of the process: it correlates the residuals of consecutive steps."""

from __future__ import annotations

import numpy as np
import pytest
import scipy
import torch

from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples, preceding
from surrogym_server.models.guard import learn
from surrogym_server.sampling.judging import judge_model
from surrogym_server.sampling.sensor_noise import CRITICAL, MAINLY, best_share, sensor_noise, sensor_pattern
from surrogym_server.sampling.state import DesignState, Request
from surrogym_server.sampling.tolerances import default_tolerances
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform

SLOPE, COUNT, LENGTH = 0.9, 60, 10
SPEC = EnvironmentSpec(
    environment="a cart in oil",
    coordinates=(Coordinate(name="x", sampling=Uniform(low=-2, high=2)),),
    observation=(ObservationEntry(name="x", term=Term.linear(x=1)),),
    action=BoxAction(low=(-1.0,), high=(1.0,)),
    start={"x": Uniform(low=-1, high=1)},
    time_limit=20,
    query="rollout",
)
DEFINITION = definition_from_spec(SPEC)


def follows() -> torch.Tensor:
    """Episodes of ``LENGTH`` steps."""
    rows = torch.arange(COUNT)
    return torch.where(rows % LENGTH == 0, -1, rows - 1)


def residuals(process: float, sensor: float, rng: np.random.Generator) -> np.ndarray:
    """w_t + v_{t+1} - SLOPE v_t of all episodes, (COUNT,)."""
    errors = sensor * rng.normal(size=(COUNT // LENGTH, LENGTH + 1))
    return (errors[:, 1:] - SLOPE * errors[:, :-1]).ravel() + process * rng.normal(size=COUNT)


def steps(process: float, sensor: float, seed: int) -> Samples:
    """Measured steps x' = SLOPE x + u / 2, and the reward -x^2 of the true state."""
    rng = np.random.default_rng(seed)
    rows: list[tuple[float, float, float, float]] = []
    for _ in range(COUNT // LENGTH):
        x = rng.uniform(-1, 1)
        seen = x + sensor * rng.normal()
        for u in rng.uniform(-1, 1, LENGTH):
            after = SLOPE * x + u / 2 + process * rng.normal()
            seen_after = after + sensor * rng.normal()
            rows.append((seen, u, seen_after, -(x**2)))
            x, seen = after, seen_after
    q, u, q_next, reward = (torch.tensor(column, dtype=torch.float64) for column in np.array(rows).T)
    return Samples(q[:, None], u[:, None], q_next[:, None], reward, torch.zeros(COUNT, dtype=torch.bool))


def test_the_sensor_noise_pattern_equals_the_covariance_of_its_residuals() -> None:
    rng = np.random.default_rng(0)
    many = np.stack([residuals(0.0, 1.0, rng) for _ in range(20_000)])
    pattern = sensor_pattern(torch.full((COUNT,), SLOPE, dtype=torch.float64), follows())
    assert np.cov(many.T) == pytest.approx((1 + SLOPE**2) * pattern.numpy(), abs=0.1)


def told(process: float, sensor: float, seed: int) -> bool:
    y = torch.from_numpy(residuals(process, sensor, np.random.default_rng(seed)))
    pattern = sensor_pattern(torch.full((COUNT,), SLOPE, dtype=torch.float64), follows())
    share, _, ratio = best_share(y, torch.zeros(COUNT, COUNT, dtype=torch.float64), float(y.var()), pattern)
    return ratio > CRITICAL and share >= MAINLY


def test_sensor_noise_is_detected_and_process_noise_rarely_mistaken_for_it() -> None:
    designs = 60
    assert sum(told(1.0, 0.0, seed) for seed in range(designs)) <= scipy.stats.binom.ppf(0.99, designs, 0.01)
    assert sum(told(0.0, 1.0, seed) for seed in range(designs)) >= 0.9 * designs


def test_the_preceding_step_is_the_one_that_ended_at_the_start_state() -> None:
    taken = steps(0.0, 0.1, seed=0)
    assert torch.equal(preceding(DEFINITION, taken), follows())
    taken.terminated[3] = True
    assert preceding(DEFINITION, taken)[4] == -1, "an episode ended there"


@pytest.mark.parametrize("seed", range(2))
def test_sensor_noise_is_estimated_from_the_residuals_of_a_learned_model(seed: int) -> None:
    taken = steps(0.0, 0.04, seed)
    model = learn(DEFINITION, taken, {}).model
    defaults = default_tolerances(DEFINITION, model.scales.tolist())
    request = Request(budget=COUNT, target=0.9)
    position, _ = judge_model(model, taken, defaults, request, DesignState()).confidences
    assert position.sensor_noise == pytest.approx(0.04, rel=0.35)
    assert position.noise == pytest.approx(0.04 * np.hypot(1, SLOPE), rel=0.35)


@pytest.mark.parametrize(("process", "sensor"), [(0.0, 0.0), (0.05, 0.0)])
def test_steps_without_sensor_noise_give_no_sensor_noise_estimate(process: float, sensor: float) -> None:
    taken = steps(process, sensor, seed=1)
    model = learn(DEFINITION, taken, {}).model
    assert sensor_noise(model, taken, default_tolerances(DEFINITION, model.scales.tolist())) == (None, None)


def test_single_steps_give_no_sensor_noise_estimate() -> None:
    taken = steps(0.0, 0.04, seed=0).at(torch.arange(0, COUNT, 2))
    model = learn(DEFINITION, taken, {}).model
    assert sensor_noise(model, taken, default_tolerances(DEFINITION, model.scales.tolist())) == (None, None)
