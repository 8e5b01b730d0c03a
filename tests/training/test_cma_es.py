"""CMA-ES over a port: it learns, the same seed finds the same policy, and evaluation reads its file."""

from pathlib import Path

import numpy as np
import pytest

from support.models import learn
from support.real_steps import random_steps
from surrogym_sampler.original.classic import cartpole, mountain_car_continuous, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.local import LocalSurrogate
from surrogym_shared.network import Network
from surrogym_trainer.evaluation import imagined_returns
from surrogym_trainer.policies import load_policy
from surrogym_trainer.training import TrainingInterrupted, TrainSettings, train
from surrogym_trainer.training.search import is_prolonged

SMALL = {"population": 8, "starts": 2, "units": 4}


def local(spec) -> LocalSurrogate:
    return LocalSurrogate(spec, learn(definition_from_spec(spec), random_steps(spec, 12, seed=0)).model)


def short(spec):
    return spec.model_copy(update={"time_limit": 20})


def small(**settings) -> TrainSettings:
    return TrainSettings(**{"algorithm": "cmaes", "hyperparameters": SMALL} | settings)


@pytest.fixture(scope="module")
def surrogate() -> LocalSurrogate:
    return local(short(pendulum()))


def test_the_number_of_cma_es_generations_follows_from_the_virtual_steps(surrogate, tmp_path: Path):
    seen = []
    result = train(surrogate, tmp_path / "policy.zip", small(total_steps=8 * 2 * 20 * 3 + 10), seen.append)
    assert result.virtual_steps == 8 * 2 * 20 * 3
    assert [p.steps for p in seen] == [320, 640, 960]
    assert result.imagined_return == max(p.imagined_return for p in seen)
    assert not surrogate._sessions


def test_cma_es_with_zero_hidden_units_searches_a_linear_policy(surrogate, tmp_path: Path):
    """Such a policy is saved, read and acts as any other."""
    linear = {**SMALL, "units": 0}
    result = train(surrogate, tmp_path / "policy.zip", small(total_steps=640, hyperparameters=linear))
    policy = Network.load(result.path)
    assert [layer.weights.shape for layer in policy.layers] == [(3, 1)]
    observations = np.random.default_rng(0).normal(size=(5, 3))
    x = (observations - policy.mean) / policy.deviation
    expected = 2 * np.tanh(x @ policy.layers[0].weights + policy.layers[0].bias)
    np.testing.assert_allclose(load_policy(result.path)(observations), expected, atol=1e-6)


def test_cma_es_reports_the_uncertainty_penalty(surrogate, tmp_path: Path):
    reports, results = [], []
    for penalty in (0.0, 100.0):
        settings = small(session={"penalty": penalty}, total_steps=320)
        results.append(train(surrogate, tmp_path / "policy.zip", settings, reports.append))
    free, penalised = reports
    assert (free.penalty_share, free.episode_penalty, results[0].episode_penalty) == (0.0, None, None)
    assert penalised.penalty_share > 1e-3
    assert results[1].episode_penalty == penalised.episode_penalty > 0


def test_cma_es_finds_the_same_policy_with_the_same_seed(surrogate, tmp_path: Path):
    def found(seed: int) -> np.ndarray:
        return Network.load(train(surrogate, tmp_path / "p.zip", small(seed=seed, total_steps=1_000)).path).vector

    np.testing.assert_array_equal(found(0), found(0))
    assert not np.array_equal(found(0), found(1))


def test_cma_es_learns_to_balance_and_evaluate_reads_its_policy(tmp_path: Path):
    surrogate = local(cartpole().model_copy(update={"time_limit": 60}))
    result = train(surrogate, tmp_path / "policy.zip", small(total_steps=12 * 8 * 2 * 60))
    assert result.imagined_return > 55
    returns = imagined_returns(surrogate, load_policy(result.path), 16, seed=5)
    assert returns.mean() > 50


def test_cma_es_continues_from_a_saved_network(surrogate, tmp_path: Path):
    first = train(surrogate, tmp_path / "first.zip", small(total_steps=3_000))
    second = train(surrogate, tmp_path / "second.zip", small(start_from=first.path, seed=1, total_steps=320))
    assert second.path.exists()
    wider = small(total_steps=320, start_from=first.path, hyperparameters=SMALL | {"units": 6})
    with pytest.raises(ValueError, match="expected a network with 31 parameters"):
        train(surrogate, tmp_path / "third.zip", wider)


@pytest.mark.parametrize("units", [0, 4])
def test_cma_es_begins_with_the_saved_policy_itself(surrogate, tmp_path: Path, units):
    """Also with another seed, whose observations of the sampling range have other statistics."""
    choices = {**SMALL, "units": units}
    first = train(surrogate, tmp_path / "first.zip", small(total_steps=1_000, hyperparameters=choices))
    again = small(start_from=first.path, seed=1, total_steps=320, hyperparameters=choices | {"sigma": 1e-12})
    second = train(surrogate, tmp_path / "second.zip", again)
    np.testing.assert_allclose(Network.load(second.path).vector, Network.load(first.path).vector, atol=1e-9)
    if units:
        np.testing.assert_array_equal(Network.load(second.path).mean, Network.load(first.path).mean)


def test_a_linear_policy_of_cma_es_is_scaled_by_the_observations_that_candidates_saw(tmp_path: Path):
    surrogate = local(cartpole().model_copy(update={"time_limit": 10}))
    linear, other = (small(total_steps=640, hyperparameters=SMALL | {"units": units}) for units in (0, 4))
    visited, anywhere = (
        Network.load(train(surrogate, tmp_path / "p.zip", one).path).deviation for one in (linear, other)
    )
    assert (visited < anywhere).all()  # starts are near the upright pole


def test_unknown_cma_es_hyperparameters_are_refused(surrogate, tmp_path: Path):
    with pytest.raises(ValueError, match="population, starts, units, sigma, got gamma"):
        train(surrogate, tmp_path / "policy.zip", small(hyperparameters={"gamma": 0.9}))


def test_a_cma_es_training_is_not_extended_while_the_policy_improves(surrogate, tmp_path: Path):
    with pytest.raises(ValueError, match="can't be prolonged"):
        train(surrogate, tmp_path / "policy.zip", small(prolong=True))
    assert not list(tmp_path.iterdir())
    assert not is_prolonged(small(total_steps=None), pendulum())


def test_cma_es_finds_a_policy_to_a_goal_far_from_the_start(tmp_path: Path):
    """Whole policies explore: noise on each action leads nowhere here."""
    surrogate = local(mountain_car_continuous())
    settings = TrainSettings(
        algorithm="cmaes", total_steps=8 * 16 * 2 * 999, hyperparameters={"population": 16, "starts": 2, "units": 4}
    )
    assert train(surrogate, tmp_path / "policy.zip", settings).imagined_return > 80


def test_an_interrupted_cma_es_training_keeps_its_best_policy(surrogate, tmp_path: Path):
    def interrupt(now):
        raise KeyboardInterrupt

    with pytest.raises(TrainingInterrupted) as interrupted:
        train(surrogate, tmp_path / "policy.zip", small(total_steps=3_000), interrupt)
    result = interrupted.value.result
    assert 0 < result.virtual_steps < 3_000
    assert Network.load(result.path).vector.size
