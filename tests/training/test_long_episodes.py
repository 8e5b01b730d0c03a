"""A training has short episodes from anywhere if nothing ends the long ones of its task."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torch import Tensor

from support.models import learn
from support.plane import Pay, drifting, plane
from surrogym_client.environments.lanes import Lanes
from surrogym_server.convert import definition_from_spec
from surrogym_server.local import LocalSurrogate
from surrogym_shared.spec import BoxAction, DiscreteAction, EnvironmentSpec, Inequality, Term
from surrogym_trainer.training import TrainSettings, train
from surrogym_trainer.training.fast_ppo import search as searches
from surrogym_trainer.training.fast_ppo.learner import Learner, restored
from surrogym_trainer.training.fast_ppo.long_episodes import LONG, MORE, NOISE, SHORTER, SIGHT, with_short_episodes
from surrogym_trainer.training.fast_ppo.rollouts import Collector
from surrogym_trainer.training.fast_ppo.search import units_of
from surrogym_trainer.training.proportions import suggested_gamma
from surrogym_trainer.training.search import SearchTask

ROLLOUT, LIMIT, STEPS = 16, 200, 1_000
FAR = Inequality(term=Term.linear(x=1), relation=">", value=0.9)


def summed(q: Tensor, u: Tensor) -> Tensor:
    return q[:, 0] + u[:, 0]


def task(
    settings: TrainSettings | None = None, *, prolong: bool = True, pay: Pay = summed, **changes: Any
) -> SearchTask:
    spec: EnvironmentSpec = plane().model_copy(update={"time_limit": LIMIT, **changes})
    model = learn(definition_from_spec(spec), drifting(pay, 12)).model
    return SearchTask(LocalSurrogate(spec, model), settings or TrainSettings(), STEPS, Path("policy.zip"), prolong)


def test_long_episodes_become_short_and_begin_anywhere():
    changed = with_short_episodes(task(), ROLLOUT)
    assert changed.settings.learning == {"seed": 0, "start_box": 1.0, "time_limit": LIMIT // SHORTER}
    assert changed.settings.judging == {}, "checks are whole episodes from the declared starts"
    assert (changed.steps, changed.prolong, changed.patient, changed.noise) == (MORE * STEPS, True, True, NOISE)
    assert changed.gamma == pytest.approx(1 - 1 / (SIGHT * LIMIT / SHORTER))


def test_a_chosen_number_of_steps_is_kept_and_its_noise_may_fall():
    changed = with_short_episodes(task(prolong=False), ROLLOUT)
    assert (changed.steps, changed.noise) == (STEPS, 0.0)


def test_noise_is_raised_to_its_least_share_and_never_lowered():
    spec = plane().model_copy(update={"action": BoxAction(low=(-1.0, 0.0), high=(1.0, 8.0))})
    learner = Learner(spec, np.zeros(2), np.ones(2), (8,), np.random.default_rng(0))
    first = learner.further.copy()
    learner.further[:] = first + np.log([0.1, 3.0])
    learner.keep_noise(0.5)
    np.testing.assert_allclose(np.exp(learner.further - first), [0.5, 3.0], rtol=1e-6)
    learner.keep_noise(0.0)
    np.testing.assert_allclose(np.exp(learner.further - first), [0.5, 3.0], rtol=1e-6)


def test_choices_have_no_noise_to_keep():
    spec = plane().model_copy(update={"action": DiscreteAction(n=3)})
    learner = Learner(spec, np.zeros(2), np.ones(2), (8,), np.random.default_rng(0))
    before = learner.parameters.copy()
    learner.keep_noise(0.5)
    np.testing.assert_array_equal(learner.parameters, before)


@pytest.mark.parametrize("prolong", [True, False])
def test_the_noise_of_a_long_training_stays(prolong: bool, tmp_path: Path):
    """The best action is 0, and noise costs, so without a bound it falls.

    The policy that is kept may be an early one, with much noise. Which one it is depends on rounding, and so on the
    processor. So the smallest noise of three trainings counts.
    """
    hyper = {"n_steps": ROLLOUT, "batch_size": 32, "n_epochs": 10, "learning_rate": 0.01, "gamma": 0.98}
    shares = []
    for seed in range(3):
        given, path = task(pay=lambda _, u: -(u[:, 0] ** 2)), tmp_path / f"policy-{seed}.zip"
        settings = TrainSettings(
            total_steps=16 * ROLLOUT * 8, num_envs=8, prolong=prolong, hyperparameters=hyper, seed=seed
        )
        train(given.port, path, settings)
        spec = given.port.spec()
        learner = restored(path, spec, units_of(spec))
        shares.append(np.exp(learner.further - learner.distribution.further()).item())
    assert (min(shares) >= NOISE - 1e-6) is prolong


@pytest.mark.parametrize(
    "other",
    [
        {"time_limit": LONG * ROLLOUT},
        {"time_limit": None},
        {"termination": ((FAR,),)},
        {"settings": TrainSettings(start_box=0.5)},
        {"settings": TrainSettings(session={"time_limit": 150})},
        {"settings": TrainSettings(horizon=20)},
        {"settings": TrainSettings(start_visited=0.5)},
    ],
    ids=["short episodes", "no time limit", "termination", "chosen starts", "chosen limit", "horizon", "visited"],
)
def test_another_training_is_unchanged(other: dict[str, Any]):
    given = task(**other)
    assert with_short_episodes(given, ROLLOUT) is given


def test_the_settings_of_the_policy_name_starts_and_episodes(tmp_path: Path):
    small = {"n_steps": ROLLOUT, "batch_size": 64, "n_epochs": 1}
    settings = TrainSettings(total_steps=2 * ROLLOUT * 8, num_envs=8, hyperparameters=small)
    result = train(task().port, tmp_path / "policy.zip", settings)
    assert (result.settings["start_box"], result.settings["time_limit"]) == (1.0, LIMIT // SHORTER)


@pytest.mark.parametrize(("chosen", "discounts"), [({}, 2), ({"gamma": 0.9}, 1)], ids=["nobody", "the user"])
def test_a_second_network_looks_further_if_nobody_chose_the_discount(
    chosen, discounts: int, tmp_path: Path, monkeypatch
):
    """The discount of short episodes serves some tasks, and that of whole episodes others. The better one stays."""
    seen: list[float] = []

    class Watched(Collector):
        def __init__(self, lanes: Lanes, gamma: float, gae_lambda: float, seed: int) -> None:
            seen.append(gamma)
            super().__init__(lanes, gamma, gae_lambda, seed)

    monkeypatch.setattr(searches, "Collector", Watched)
    given = task()
    small = {"n_steps": ROLLOUT, "batch_size": 64, "n_epochs": 1, **chosen}
    steps = 2 * ROLLOUT * 8
    settings = TrainSettings(total_steps=steps, num_envs=8, hyperparameters=small, prolong=True)
    progress: list[int] = []
    result = train(given.port, tmp_path / "policy.zip", settings, lambda now: progress.append(now.steps))
    whole, short = suggested_gamma(given.port.spec()), 1 - 1 / (SIGHT * LIMIT / SHORTER)
    assert seen == ([short, whole] if discounts == 2 else [0.9])
    assert result.settings["gamma"] in seen
    assert progress == sorted(progress)
    assert result.virtual_steps == progress[-1]
    assert result.networks == 1, "no network was abandoned"
