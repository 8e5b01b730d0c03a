"""Optimisation by gradients: the gradient is the true one, it learns, and what has none is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from support.exact_models import exact_pendulum
from support.models import learn
from support.real_steps import random_steps
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.errors import InvalidInput
from surrogym_server.gradients import GradientSettings, Update, _evened, optimise
from surrogym_server.local import LocalSurrogate
from surrogym_shared.wire import OpenSession
from surrogym_trainer.evaluation import imagined_returns
from surrogym_trainer.policies import load_policy

SMALL = GradientSettings(updates=12, lanes=16, horizon=20, units=8)


def local(spec) -> LocalSurrogate:
    return LocalSurrogate(spec, learn(definition_from_spec(spec), random_steps(spec, 12, seed=0)).model)


@pytest.fixture(scope="module")
def surrogate() -> LocalSurrogate:
    return local(pendulum().model_copy(update={"time_limit": 30}))


def test_steps_of_the_model_are_differentiable(surrogate):
    model = surrogate.model
    u = torch.full((2, 1), 0.3, dtype=torch.float64)

    def returned(q: torch.Tensor) -> torch.Tensor:
        first = model.transition(q, u)
        return first.reward.sum() + model.transition(first.q_next, u).reward.sum()

    q = torch.tensor([[2.0, 0.5], [-0.4, -1.0]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(returned, q, atol=1e-4)


def test_gradients_pass_through_tensors_that_a_step_has_cached(surrogate):
    fresh = local(surrogate.spec())
    session = fresh.open(OpenSession(num_envs=2, seed=0)).id
    fresh.reset(session)
    fresh.step(session, np.zeros((2, 1)))
    u = torch.full((2, 1), 0.3, dtype=torch.float64, requires_grad=True)
    moved = fresh.model.transition(torch.zeros(2, 2, dtype=torch.float64), u)
    (gradient,) = torch.autograd.grad(moved.reward.sum() + fresh.model.definition.observe(moved.q_next).sum(), u)
    assert bool((gradient != 0).all())


def test_a_model_that_can_not_be_differentiated_is_refused():
    with pytest.raises(InvalidInput, match="can be differentiated, got one of the family 'gaussian_process'"):
        optimise(LocalSurrogate(pendulum(), exact_pendulum()), SMALL)


def test_it_learns_to_hold_the_pendulum_up(tmp_path: Path):
    near = pendulum().start | {"theta": pendulum().start["theta"].model_copy(update={"low": -0.3, "high": 0.3})}
    surrogate = local(pendulum().model_copy(update={"start": near, "time_limit": 40}))
    found = optimise(surrogate, GradientSettings(updates=60, lanes=32, horizon=20, units=8))
    path = tmp_path / "policy.zip"
    found.policy.save(path)
    held = imagined_returns(surrogate, load_policy(path), 64, seed=0).mean()
    assert held == pytest.approx(found.imagined_return, rel=1e-3), "the same starts, through the lanes of a session"
    falling = imagined_returns(surrogate, lambda o: np.zeros((len(o), 1)), 64, seed=0).mean()
    assert held > falling / 3


def test_the_same_seed_finds_the_same_policy(surrogate):
    def found(seed: int) -> np.ndarray:
        return optimise(surrogate, GradientSettings(updates=3, lanes=8, horizon=5, units=4, seed=seed)).policy.vector

    np.testing.assert_array_equal(found(0), found(0))
    assert not np.array_equal(found(0), found(1))


def test_checks_and_steps_are_reported(surrogate):
    seen = []
    found = optimise(surrogate, SMALL, seen.append)
    assert [update.number for update in seen] == list(range(1, 13))
    assert found.imagined_return == max(update.imagined_return for update in seen)
    assert found.virtual_steps == 12 * (16 * 20 + 64 * 30)


@pytest.mark.parametrize("updates", [1, 5], ids=["before a check", "after a check"])
def test_ctrl_c_gives_the_best_policy_once_one_was_checked(surrogate, updates: int):
    def interrupt(now: Update) -> None:
        if now.number == updates:
            raise KeyboardInterrupt

    settings = replace(SMALL, updates=24)  # a check after every second update
    if updates == 1:
        with pytest.raises(KeyboardInterrupt):
            optimise(surrogate, settings, interrupt)
    else:
        found = optimise(surrogate, settings, interrupt)
        assert not found.whole
        assert found.imagined_return > -np.inf


def test_no_lane_outweighs_the_others():
    gradient = torch.tensor([[1.0, 0.0], [0.0, 1.0], [3e9, 4e9]])
    evened = _evened(gradient)
    torch.testing.assert_close(evened[:2], gradient[:2])
    torch.testing.assert_close(evened[2], torch.tensor([1.2, 1.6]))


def test_discrete_actions_are_refused():
    spec = cartpole()
    with pytest.raises(InvalidInput, match="expected continuous actions, got discrete ones"):
        optimise(local(spec), SMALL)
