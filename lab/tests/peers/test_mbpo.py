"""MBPO keeps the best networks, imagines from real states until an episode ends, and mixes real and imagined steps."""

import numpy as np
import pytest
import torch

from surrogym_lab.peers.methods.elites import Trained, fit, held_out
from surrogym_lab.peers.methods.ensemble import Ensemble
from surrogym_lab.peers.methods.mbpo import Mbpo, Model, Pools, Settings, Transitions
from surrogym_lab.peers.methods.states import States
from surrogym_lab.peers.port import BudgetSpent, Clock, Real
from surrogym_sampler.original import make
from surrogym_sampler.original.episodes import open_episode

SMALL = Settings(
    hidden=(32, 32), decay=(0.0, 0.0, 0.0), epoch=1, explore=40, every=20, rollouts=20, updates=2, batch=32
)


def samples(n=2_000):
    torch.manual_seed(0)
    x = torch.rand(n, 1) * 2 - 1
    return x, torch.sin(2 * x) + 0.03 * torch.randn_like(x)


def ensemble(networks=4):
    return Ensemble(1, 1, networks=networks, hidden=(32, 32), decay=(0.0, 0.0, 0.0))


def test_mbpo_training_stops_by_itself_and_keeps_the_networks_best_on_held_out_samples():
    x, y = samples()
    model = ensemble()
    trained = fit(model, torch.optim.Adam(model.parameters(), 3e-3), x, y, 2, 1, np.random.default_rng(0), lambda: None)
    errors = held_out(model, x, y)
    assert errors.max() < 0.01
    assert len(trained.elites) == 2
    drawn = trained.drawn(x)
    assert ((drawn - y) ** 2).mean() < 0.01


def test_mbpo_keeps_earlier_networks_if_training_makes_them_worse():
    x, y = samples(200)  # one step an epoch
    model = ensemble()
    model.scale_by(x)
    fit(model, torch.optim.Adam(model.parameters(), 3e-3), x, y, 2, 1, np.random.default_rng(0), lambda: None)
    before = [part.detach().clone() for part in model.weights]
    optimizer, steps = torch.optim.SGD(model.parameters(), 0.0), 0

    def worse():
        nonlocal steps
        steps += 1
        optimizer.param_groups[0]["lr"] = 0.0 if steps == 1 else 1.0

    fit(model, optimizer, x, y, 2, 1, np.random.default_rng(0), worse)
    assert steps == 7  # the first epoch, five more, and the one after which it gives up
    for part, kept in zip(model.weights, before, strict=True):
        torch.testing.assert_close(part.detach(), kept)


def test_an_mbpo_epoch_over_few_samples_repeats_them():
    x, y = samples(500)  # two batches
    model, steps = ensemble(), 0

    def counted():
        nonlocal steps
        steps += 1

    fit(model, torch.optim.SGD(model.parameters(), 0.0), x, y, 2, 5, np.random.default_rng(0), counted)
    assert steps == 7 * 6  # seven epochs of three passes


def test_mbpo_samples_predictions_from_every_elite_network_and_no_other():
    model = ensemble(networks=3)
    with torch.no_grad():
        for part in model.weights:
            part.zero_()
        model.biases[-1][:, 0, 0] = torch.tensor([1.0, 2.0, 3.0])
        model.biases[-1][:, 0, 1] = -50.0  # no noise
    drawn = Trained(model, torch.tensor([2, 0])).drawn(torch.zeros(11, 1))
    counts = {round(value): int((drawn.round() == value).sum()) for value in (1.0, 2.0, 3.0)}
    assert counts[2] == 0
    assert sorted((counts[1], counts[3])) == [5, 6]


class Pushed:
    """Moves a cart by a tenth of the control, and pays the control."""

    def drawn(self, x):
        outputs = torch.zeros(len(x), 5)
        outputs[:, 0] = x[:, -1]
        outputs[:, 1] = 0.1 * x[:, -1]
        return outputs


def test_mbpo_rollouts_start_at_real_states_and_end_with_the_episode():
    states = States(make("CartPole-v1").spec())
    model = Model(states, Settings(every=10, rollouts=5, length=3), np.random.default_rng(0))
    model._trained = Pushed()
    seen = np.array([[0.0, 0, 0, 0], [2.25, 0, 0, 0]], np.float32)
    found = model.rollouts(seen, lambda at: np.full((len(at), 1), 0.4, np.float32))  # is rounded to 1
    first = found.seen[:50, 0]
    assert found.reward == pytest.approx(np.ones(len(found.reward)))
    np.testing.assert_allclose(found.reached[:, 0] - found.seen[:, 0], 0.1, atol=1e-6)
    assert found.reached[found.ended == 1][:, 0] == pytest.approx(2.45)
    assert found.reached[found.ended == 0][:, 0].max() < 2.4
    assert len(found.seen) == 50 + 2 * (first == 0).sum() + (first > 0).sum()


def test_an_mbpo_batch_contains_its_share_of_real_transitions():
    pools = Pools(10, 1, 1, np.random.default_rng(0), share=0.05)
    for _ in range(3):
        pools.add(np.ones(1), np.ones(1), 1.0, np.ones(1), ended=True)
    assert pools.real.reward.tolist() == [1, 1, 1]
    none = np.zeros((7, 1), np.float32)
    pools.imagined = Transitions(none, none, none[:, 0], none, none[:, 0])
    batch = pools.sample(256)
    for part in (batch.observations, batch.actions, batch.rewards, batch.next_observations, batch.dones):
        assert part.shape == (256, 1)
        assert part.sum() == 12


@pytest.mark.parametrize("name", ["Pendulum-v1", "CartPole-v1"])
def test_mbpo_returns_a_policy_every_fifty_real_steps_after_the_random_ones(name):
    spec = make(name).spec()
    real = Real(spec, lambda: open_episode(name, spec, lambda: make(name)), 0, 140, Clock(600.0))
    found = []

    def learn():
        found.extend((real.steps, policy) for policy in Mbpo(SMALL).learn(real, 0))

    with pytest.raises(BudgetSpent):
        learn()
    assert [steps for steps, _ in found] == [90, 140]
    shown = np.zeros((5, len(spec.observation)), np.float32)
    assert np.asarray(found[-1][1](shown)).shape == (5, 1)
