"""Noise told from misfit: only a step that is taken again and differs shows that the environment is noisy."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import scipy
import torch

from support.exact_models import ExactModel, exact_pendulum
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.models.abilities import LearnedNoise
from surrogym_server.sampling.design import advance
from surrogym_server.sampling.noise import (
    ENOUGH,
    LEVEL,
    NEGLIGIBLE,
    STAGES,
    established_noise,
    repeats,
    to_repeat,
    widened_by,
)
from surrogym_server.sampling.state import DesignState, Request

TOLERANCES = (0.01, 0.01, 0.01)


@dataclass(frozen=True)
class ClaimsNoise(ExactModel, LearnedNoise):
    """It takes what it can't explain for noise."""

    noise: tuple[float, ...] = (0.2, 0.0, 0.0)

    @property
    def noise_stds(self) -> tuple[float, ...]:
        return self.noise


@pytest.fixture(scope="module")
def model() -> ClaimsNoise:
    exact = exact_pendulum()
    return ClaimsNoise(exact.definition, exact.move, exact.pay)


def samples(model: ExactModel, again: int, noise: float = 0.0, count: int = 12, seed: int = 0) -> Samples:
    """Steps from random states, the first ones of which were taken again, ``again`` times in all."""
    rng = np.random.default_rng(seed)
    which = [*range(count), *(i % count for i in range(again))]
    q, u = torch.tensor(rng.uniform(-1, 1, (count, 2)))[which], torch.tensor(rng.uniform(-1, 1, (count, 1)))[which]
    q_next = model.move(q, u)
    q_next[:, 0] += noise * torch.tensor(rng.normal(size=len(q)))
    return Samples(q, u, q_next, model.pay(q, u), torch.zeros(len(q), dtype=torch.bool))


def test_the_noise_estimate_pools_the_deviations_of_repeated_steps(model: ClaimsNoise):
    taken = samples(model, again=400, noise=0.3)
    found = repeats(model, taken)
    assert found.degrees == 400
    assert found.std.tolist() == pytest.approx([0.3, 0.0, 0.0], abs=0.03)
    assert repeats(model, samples(model, again=0)).degrees == 0


def test_noise_counts_as_detected_only_after_enough_repeated_steps(model: ClaimsNoise):
    assert established_noise(model, samples(model, again=ENOUGH - 1, noise=0.2), TOLERANCES).tolist() == [0, 0, 0]
    assert established_noise(model, samples(model, again=8, noise=0.2), TOLERANCES).tolist() == [0.2, 0, 0]


def repeated(model: ClaimsNoise, noise: float, seed: int) -> tuple[float, int]:
    """The established noise of the first output, and the number of repeats, once no more are asked for."""
    again = 0
    while (more := to_repeat(model, taken := samples(model, again, noise, seed=seed), TOLERANCES)) is not None:
        again += len(more)
    return float(established_noise(model, taken, TOLERANCES)[0]), again


@pytest.mark.parametrize("claimed", [0.2, 0.015])
def test_negligible_noise_is_rarely_detected(model: ClaimsNoise, claimed: float):
    """The model claims misfit of 20 tolerances as noise, or three times the noise that there is."""
    tests, designs = sum(stage >= ENOUGH for stage in STAGES), 100
    claims = replace(model, noise=(claimed, 0.0, 0.0))
    found = [repeated(claims, NEGLIGIBLE * TOLERANCES[0], seed) for seed in range(designs)]
    assert sum(noise > 0 for noise, _ in found) <= scipy.stats.binom.ppf(0.99, designs, tests * LEVEL)


@pytest.mark.parametrize(("noise", "share"), [(0.04, 0.95), (0.02, 0.85)])
def test_noise_above_the_tolerance_is_detected_with_few_repeats(model: ClaimsNoise, noise: float, share: float):
    claims = replace(model, noise=(noise, 0.0, 0.0))
    found = [repeated(claims, noise, seed) for seed in range(50)]
    assert sum(established > 0 for established, _ in found) >= share * len(found)
    assert np.mean([again for _, again in found]) < STAGES[2], "few repeats suffice"


def test_model_misfit_in_a_deterministic_environment_is_not_taken_for_noise(model: ClaimsNoise):
    assert established_noise(model, samples(model, again=8), TOLERANCES).tolist() == [0, 0, 0]


def test_the_models_noise_estimate_is_capped_by_the_repeated_steps(model: ClaimsNoise):
    louder = replace(model, noise=(50.0, 0.0, 0.0))
    found = float(established_noise(louder, samples(model, again=50, noise=0.2), TOLERANCES)[0])
    assert found == pytest.approx(0.6, rel=0.3)


def test_further_repeats_of_a_step_are_queried_only_if_the_first_repeat_differs(model: ClaimsNoise):
    first = to_repeat(model, samples(model, again=0), TOLERANCES)
    assert first is not None
    assert len(first) == 1
    assert to_repeat(model, samples(model, again=1), TOLERANCES) is None, "the environment is deterministic"
    more = to_repeat(model, samples(model, again=1, noise=0.2), TOLERANCES)
    assert more is not None
    assert len(more) == ENOUGH - 1
    assert to_repeat(model, samples(model, again=ENOUGH, noise=0.2), TOLERANCES) is None


def test_noise_below_the_tolerance_is_not_tested_by_repeats(model: ClaimsNoise):
    quiet = replace(model, noise=(0.005, 0.0, 0.0))
    assert to_repeat(quiet, samples(model, again=0), TOLERANCES) is None
    assert established_noise(quiet, samples(model, again=9, noise=0.005), TOLERANCES).tolist() == [0, 0, 0]


def test_no_repeated_steps_are_queried_for_a_model_that_learns_no_noise(model: ClaimsNoise):
    plain = exact_pendulum()
    assert to_repeat(plain, samples(model, again=0), TOLERANCES) is None
    assert established_noise(plain, samples(model, again=9, noise=0.2), TOLERANCES).tolist() == [0, 0, 0]


def test_tolerances_are_widened_by_noise_and_unchanged_without_it():
    assert widened_by(torch.tensor([0.0, 0.4], dtype=torch.float64), (0.1, 0.3)) == (0.1, 0.5)


def test_a_design_in_a_noisy_environment_repeats_steps_and_becomes_ready(model: ClaimsNoise):
    rng, spread = np.random.default_rng(1), torch.tensor([0.0628, 0.16], dtype=torch.float64)  # 1 % of the ranges

    def real(points: Points) -> Samples:
        moved = model.move(points.q, points.u) + spread * torch.tensor(rng.normal(size=(len(points), 2)))
        return Samples(points.q, points.u, moved, model.pay(points.q, points.u), torch.zeros(len(points)).bool())

    low, high = torch.tensor([[-np.pi, -8.0, -2.0], [np.pi, 8.0, 2.0]])
    points = low + (high - low) * torch.tensor(rng.random((24, 3)))
    taken, state = real(Points(points[:, :2], points[:, 2:])), DesignState()
    request = Request(budget=48, target=0.99)
    while (decision := advance(model.definition, taken, state, request)).verdict == "continue":
        state, more = decision.state, real(Points.of(model.definition, decision.queries))
        fields = ("q", "u", "q_next", "reward", "terminated")
        taken = Samples(*(torch.cat([getattr(taken, name), getattr(more, name)]) for name in fields))
    assert decision.verdict == "ready"
    assert repeats(model, taken).degrees == ENOUGH
    theta, speed, reward = (output.noise for output in decision.confidences)
    assert (theta, speed) == pytest.approx(spread.tolist(), rel=0.6)
    assert reward == 0.0
