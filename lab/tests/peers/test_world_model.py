"""The recurrent network learns mixtures and ends, its dream follows them, and a controller remembers its episode."""

import numpy as np
import pytest
import torch

from surrogym_lab.peers.methods.mixture_network import Episode, MixtureNetwork, train
from surrogym_lab.peers.methods.states import States
from surrogym_lab.peers.methods.world_model import (
    Controlled,
    Dream,
    Settings,
    WorldModel,
    search,
    starts,
)
from surrogym_lab.peers.port import BudgetSpent, Clock, Real
from surrogym_sampler.original import make
from surrogym_sampler.original.episodes import open_episode

SMALL = Settings(hidden=8, training=3, collect=20, population=6, rollouts=2, generations=2)


def jumps(episodes=20, steps=30):
    """A number that jumps by one, up or down at random, pays its action, and ends its episode above 2."""
    rng = np.random.default_rng(0)
    found = []
    for _ in range(episodes):
        seen, action = [0.0], rng.uniform(-1, 1, (steps, 1))
        while len(seen) <= steps and seen[-1] < 2:
            seen.append(seen[-1] + rng.choice([-1.0, 1.0]))
        action = action[: len(seen) - 1]
        parts = (np.array(seen)[:, None], action, action[:, 0])
        found.append(Episode(*(torch.from_numpy(part).float() for part in parts), seen[-1] >= 2))
    return found


def test_the_world_model_learns_a_bimodal_step_reward_and_termination():
    torch.manual_seed(0)
    model = MixtureNetwork(1, 1, hidden=16, components=5)
    train(model, torch.optim.Adam(model.parameters(), 1e-2), jumps(), steps=500, check=lambda: None)
    n, rng = 400, np.random.default_rng(1)
    noise = tuple(torch.from_numpy(part).float() for part in (rng.random((n, 2)), rng.standard_normal((n, 2))))
    seen, action = torch.zeros(n, 1), torch.full((n, 1), 0.5)
    with torch.no_grad():
        reward, reached, ended, _ = model.drawn(seen, action, model.start(n), noise, 1.0)
    change = reached - seen
    assert 0.35 < (change > 0).float().mean() < 0.65
    assert (change.abs() - 1).abs().max() < 0.6  # one normal distribution would have many near 0
    assert reward.mean().item() == pytest.approx(0.5, abs=0.1)
    assert not ended.any()
    with torch.no_grad():
        *_, ended, _ = model.drawn(seen + 1, action, model.start(n), noise, 1.0)
    assert ended.all()  # half of them do, and an end weighs ten times as much


def test_a_higher_sampling_temperature_widens_world_model_draws():
    torch.manual_seed(0)
    model = MixtureNetwork(1, 1, hidden=4, components=1)
    noise = torch.full((200, 2), 0.5), torch.randn(200, 2)
    zero = torch.zeros(200, 1)
    with torch.no_grad():
        drawn = [model.drawn(zero, zero, model.start(200), noise, warmth)[1] for warmth in (1.0, 4.0)]
    assert drawn[1].std().item() == pytest.approx(2 * drawn[0].std().item(), rel=1e-4)


class Paying:
    """A dream's network without a memory: the observation stays, the action pays, and a step from above 0.9 ends."""

    def start(self, count):
        return torch.zeros(1, count, 2), torch.zeros(1, count, 2)

    def scaled(self, seen):
        return seen

    def drawn(self, seen, action, state, noise, temperature):
        return action[:, 0], seen, seen[:, 0] > 0.9, state


def test_a_world_model_rollout_sums_rewards_until_termination_for_each_controller():
    states = States(make("Pendulum-v1").spec())
    dream = Dream(Paying(), states, longest=10, temperature=1.0)
    theta = np.zeros((2, 6))
    theta[:, -1] = 0.3, -20.0  # bias
    rng = np.random.default_rng(0)
    seen = starts(states.spec, 8, np.random.default_rng(0))
    steps = np.where(seen[:, 0] > 0.9, 1, 10)
    assert set(steps) == {1, 10}
    np.testing.assert_allclose(dream.returns(theta, 8, rng), steps.mean() * np.tanh([0.3, -20.0]), rtol=1e-5)


def test_the_world_model_policy_search_finds_a_maximum():
    top = np.array([0.4, -0.3, 0.2])
    found = search(
        lambda theta, _: -((theta - top) ** 2).sum(1),
        Settings(population=16, generations=60),
        np.zeros(3),
        np.random.default_rng(0),
        lambda: None,
    )
    np.testing.assert_allclose(found, top, atol=0.01)


def test_a_recurrent_controller_keeps_separate_memory_for_each_episode():
    torch.manual_seed(0)
    states = States(make("Pendulum-v1").spec())
    model, rng = MixtureNetwork(3, 1, hidden=4, components=2), np.random.default_rng(0)
    dream, theta = Dream(model, states, 10, 1.0), rng.standard_normal(8)
    shown = rng.standard_normal((3, 3)).astype(np.float32)
    alone, both = Controlled(dream, theta), Controlled(dream, theta)
    wanted = [alone.actions([7], row[None])[0] for row in shown]
    found = [both.actions([3, 5], np.stack([row, shown[0]]))[0] for row in shown]
    np.testing.assert_allclose(found, wanted, rtol=1e-5)
    again = Controlled(dream, theta)
    assert not np.allclose(again.actions([7], shown[2:])[0], wanted[2])  # without the memory of two steps


@pytest.mark.parametrize("name", ["Pendulum-v1", "CartPole-v1"])
def test_a_world_model_round_takes_whole_real_episodes(name):
    spec = make(name).spec()
    real = Real(spec, lambda: open_episode(name, spec, lambda: make(name)), 0, 450, Clock(600.0))
    found = []

    def learn():
        found.extend((real.steps, policy) for policy in WorldModel(SMALL).learn(real, 0))

    with pytest.raises(BudgetSpent):
        learn()
    if name == "Pendulum-v1":
        assert [steps for steps, _ in found] == [200, 400]
    shown = np.zeros((2, len(spec.observation)), np.float32)
    assert found[-1][1].actions([0, 1], shown).shape == (2, 1)
