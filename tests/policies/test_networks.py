"""The paper's policies (section 4): one hidden layer of 32, bounded or argmax, complete in the saved file."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from torch import nn

from surrogym_trainer.policies.networks import HIDDEN, Bounded, PaperPolicy, Standardise

OBSERVED = spaces.Box(-np.inf, np.inf, (3,), np.float32)
TORQUES = spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 10.0], np.float32))
STATISTICS = {"mean": [1.0, 0.0, -2.0], "deviation": [2.0, 1.0, 4.0]}


class Idle(gymnasium.Env):
    """Something to build an algorithm on."""

    metadata = {"render_modes": []}  # noqa: RUF012
    observation_space = OBSERVED

    def __init__(self, action_space: spaces.Space) -> None:
        self.action_space = action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(3, np.float32), {}

    def step(self, action):
        return np.zeros(3, np.float32), 0.0, False, False, {}


def policy(action_space: spaces.Space) -> PaperPolicy:
    torch.manual_seed(0)
    return PaperPolicy(OBSERVED, action_space, lambda _: 1e-3, features_extractor_kwargs=STATISTICS)


def layers(module: nn.Module, kind: type[nn.Module]) -> list[nn.Module]:
    return [m for m in module.modules() if isinstance(m, kind)]


@pytest.mark.parametrize(
    ("space", "activation", "outputs"),
    [(TORQUES, nn.Tanh, 2), (spaces.Discrete(3), nn.ReLU, 3), (spaces.MultiDiscrete([3, 2]), nn.ReLU, 5)],
)
def test_the_papers_actor_network_has_one_hidden_layer_of_32_units(space, activation, outputs):
    made = policy(space)
    hidden = layers(made.mlp_extractor.policy_net, nn.Linear)
    assert [(layer.in_features, layer.out_features) for layer in hidden] == [(3, HIDDEN)]
    assert HIDDEN == 32
    assert len(layers(made.mlp_extractor.policy_net, activation)) == 1
    assert [(layer.in_features, layer.out_features) for layer in layers(made.action_net, nn.Linear)] == [(32, outputs)]


def test_continuous_policy_outputs_are_tanh_scaled_to_the_action_bounds():
    bounded = Bounded(TORQUES)
    made = bounded(torch.tensor([[0.0, 0.0], [50.0, 50.0], [-50.0, -50.0], [np.arctanh(0.5), 0.0]]).float())
    np.testing.assert_allclose(made.numpy(), [[0, 5], [2, 10], [-2, 0], [1, 5]], atol=1e-6)


def test_policy_actions_stay_within_bounds_for_any_observation():
    made = policy(TORQUES)
    with torch.no_grad():
        made.action_net[0].weight.mul_(1e3)
    actions, _ = made.predict(np.random.default_rng(0).normal(size=(200, 3)) * 100, deterministic=True)
    assert (actions >= TORQUES.low).all()
    assert (actions <= TORQUES.high).all()
    assert np.ptp(actions, axis=0).min() > 1


def test_the_initial_exploration_noise_is_a_quarter_of_the_action_range():
    np.testing.assert_allclose(policy(TORQUES).log_std.exp().detach(), [1.0, 2.5], rtol=1e-6)


@pytest.mark.parametrize("space", [spaces.Discrete(3), spaces.MultiDiscrete([3, 2])])
def test_evaluation_uses_the_most_probable_discrete_action_of_each_dimension(space):
    made, observation = policy(space), np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)
    actions, _ = made.predict(observation, deterministic=True)
    with torch.no_grad():
        logits = made.action_net(made.mlp_extractor.policy_net(made.extract_features(torch.tensor(observation))))
    sizes = [space.n] if isinstance(space, spaces.Discrete) else space.nvec.tolist()
    expected = np.stack([part.argmax(1).numpy() for part in logits.split(sizes, 1)], 1)
    np.testing.assert_array_equal(actions.reshape(40, -1), expected)
    assert len(np.unique(actions)) > 1


def test_the_policy_network_standardises_observations_by_fixed_statistics():
    made = Standardise(OBSERVED, **STATISTICS)
    np.testing.assert_allclose(made(torch.tensor([[3.0, 1.0, 2.0]])), [[1.0, 1.0, 1.0]])
    np.testing.assert_allclose(Standardise(OBSERVED)(torch.tensor([[3.0, 1.0, 2.0]])), [[3.0, 1.0, 2.0]])
    assert not list(made.parameters()), "statistics are not trained"


@pytest.mark.parametrize("space", [TORQUES, spaces.MultiDiscrete([3, 2])])
def test_a_saved_policy_gives_the_same_actions_after_loading(tmp_path: Path, space):
    extractor = {"features_extractor_kwargs": STATISTICS}
    learner = PPO(PaperPolicy, Idle(space), n_steps=8, batch_size=8, seed=1, device="cpu", policy_kwargs=extractor)
    learner.learn(8)
    learner.save(tmp_path / "policy.zip")
    loaded = PPO.load(tmp_path / "policy.zip", device="cpu")
    assert isinstance(loaded.policy, PaperPolicy)
    observation = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    for deterministic in (True, False):
        torch.manual_seed(3)
        ours, _ = learner.predict(observation, deterministic=deterministic)
        torch.manual_seed(3)
        theirs, _ = loaded.predict(observation, deterministic=deterministic)
        np.testing.assert_array_equal(ours, theirs)
