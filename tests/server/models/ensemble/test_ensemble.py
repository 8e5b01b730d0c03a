"""The ensemble of networks: members disagree where nothing was seen, a draw is a member, odd files are refused."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from support.models import learn, with_header
from support.real_steps import random_steps
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput, InvalidSpec
from surrogym_server.models.abilities import LearnedNoise, offers
from surrogym_server.models.ensemble.model import NetworkEnsembleModel, Noise
from surrogym_server.models.ensemble.training import Training, train_with_noise
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.registry import learner_of
from surrogym_server.plugins import Choice
from surrogym_shared.spec import EnvironmentSpec, ModelChoice, Reward

SETTINGS = {"steps": 200, "units": 16, "members": 4}


def designed(spec: EnvironmentSpec, **settings: int) -> EnvironmentSpec:
    chosen = ModelChoice(name="ensemble", settings=SETTINGS | settings)
    return spec.model_copy(update={"design": spec.design.model_copy(update={"model": chosen})})


def ensemble(spec: EnvironmentSpec, samples: int = 24, **settings: int) -> NetworkEnsembleModel:
    spec = designed(spec, **settings)
    model = learn(definition_from_spec(spec), random_steps(spec, samples, seed=0)).model
    assert isinstance(model, NetworkEnsembleModel)
    return model


@pytest.fixture(scope="module")
def model() -> NetworkEnsembleModel:
    return ensemble(pendulum())


@pytest.fixture(scope="module")
def definition(model) -> EnvironmentDefinition:
    return model.definition


def test_ensemble_members_disagree_more_far_from_the_samples(model):
    steps = random_steps(pendulum(), 24, seed=0)
    near = model.transition(steps.q, steps.u, stds=True).std
    far = model.transition(torch.tensor([[0.0, 60.0]]).double(), torch.zeros(1, 1).double(), stds=True).std
    assert float(far[0, 1]) > 10 * float(near[:, 1].median())


def test_a_drawn_function_is_one_ensemble_member_with_equal_probability(model):
    noise = torch.randn(2_000, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    drawn = model.draw(noise)[:, 0]
    assert drawn.unique().tolist() == [0.0, 1.0, 2.0, 3.0]
    assert int(drawn.long().bincount().min()) > 400


def test_ensemble_mean_and_deviation_are_those_over_the_members(model):
    steps = random_steps(pendulum(), 10, seed=3)
    members = torch.arange(4.0, dtype=torch.float64)[:, None]
    one = [model.transition_along(member.expand(10, 1), steps.q, steps.u) for member in members]
    speeds = torch.stack([made.q_next[:, 1] for made in one])
    made = model.transition(steps.q, steps.u, stds=True)
    torch.testing.assert_close(speeds.mean(0), made.q_next[:, 1])
    torch.testing.assert_close(speeds.std(0), made.std[:, 1])


def test_another_seed_gives_other_ensemble_members(model):
    other = ensemble(pendulum(), seed=7)
    assert not torch.equal(other.transitions.networks.first, model.transitions.networks.first)


@pytest.mark.parametrize("timing", ["before", "after", "auto"])
def test_an_ensemble_learns_rewards_of_the_state_before_or_after_the_step(timing):
    made = ensemble(pendulum().model_copy(update={"reward": Reward(timing=timing)}), samples=40)
    steps = random_steps(pendulum(), 50, seed=9)
    off = made.transition(steps.q, steps.u).reward - steps.reward
    assert float(off.square().mean().sqrt()) < 0.25 * float(steps.reward.std())


def test_an_ensemble_with_preset_paper_predicts_the_observation():
    spec = pendulum()
    made = ensemble(spec.model_copy(update={"design": spec.design.model_copy(update={"preset": "paper"})}))
    assert made.definition.outputs == ("cos", "sin", "speed", "reward")
    steps = random_steps(spec, 20, seed=9)
    off = made.transition(steps.q, steps.u).q_next - steps.q_next
    assert float(off[:, 1].square().mean().sqrt()) < 0.5 * float(steps.q_next[:, 1].std())


def test_an_ensemble_output_that_never_varied_is_constant_without_uncertainty():
    made = ensemble(cartpole())
    steps = random_steps(cartpole(), 5, seed=9)
    moved = made.transition(steps.q, steps.u, reward_std=True)
    assert made.structures[-1] == "constant"
    assert (moved.reward.tolist(), moved.reward_std.tolist()) == ([1.0] * 5, [0.0] * 5)


def test_an_ensemble_learns_from_many_samples_in_batches():
    made = ensemble(pendulum(), samples=600, steps=20)
    assert made.samples == 600


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"members": 1}, "members to be a whole number from 2 to 16, got 1"),
        ({"units": 1.5}, "expected units to be a whole number, got 1.5"),
        ({"steps": True}, "expected steps to be a whole number, got True"),
        ({"seed": -1}, "seed to be a whole number"),
        ({"beta": 1.5}, "beta to be a number from 0 to 1, got 1.5"),
        ({"depth": 3}, "expected a setting out of members, units, steps, seed, beta, got 'depth'"),
    ],
)
def test_invalid_ensemble_settings_are_refused(settings, said):
    with pytest.raises(InvalidSpec, match=said):
        learner_of(Choice("ensemble", tuple(settings.items())))


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ({"format": 1}, "expected a model of format 2, got format 1, .* export its samples with that version"),
        ({"outputs": ["theta", "reward"]}, "with the outputs"),
        ({"samples": 0}, "samples from 1 to .*, got"),
        ({"terminal_reward": float("inf")}, "finite terminal_reward"),
        ({"family": "gaussian_process"}, "family 'ensemble', as the specification says, got one of 'gaussian_process'"),
    ],
)
def test_an_ensemble_file_header_that_contradicts_the_environment_is_refused(model, definition, header, said):
    with pytest.raises(InvalidInput, match=said):
        from_bytes(definition, with_header(model, **header))


@pytest.mark.parametrize("beta", [0.0, 1.0])
def test_an_ensemble_learns_noise_that_depends_on_the_input(beta):
    """Half of the inputs have noise of 0.5, the other half none. A single noise would be right for neither."""
    x = torch.linspace(-1.5, 1.5, 300, dtype=torch.float64)[:, None]
    noise = torch.randn(300, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    y = torch.sin(x) + 0.5 * noise * (x > 0)
    networks, noisy = train_with_noise(Training(4, 16, 300, 0, beta), x, y)
    found = Noise(noisy, torch.ones(1)).std(x)[:, 0]
    assert float(found[x[:, 0] < -0.2].median()) < 0.1
    assert 0.3 < float(found[x[:, 0] > 0.2].median()) < 0.7
    quiet = x[:, 0] < -0.2
    assert float((networks(x).mean(0) - torch.sin(x))[quiet].abs().max()) < 0.1, (
        "noise elsewhere does not bend the mean"
    )


def test_with_beta_1_the_ensemble_mean_fits_a_rare_jump():
    """A rare jump: the likelihood calls it noise, and its mean passes by. With beta 1 the mean goes there."""
    x = torch.linspace(-1.5, 1.5, 400, dtype=torch.float64)[:, None]
    y = torch.where((x - 0.6).abs() < 0.06, 6.0, 0.0) + 0.1 * torch.sin(x)
    jump = y[:, 0] > 3
    errors = {}
    for beta in (0.0, 1.0):
        mean, noisy = train_with_noise(Training(4, 16, 600, 0, beta), x, y)
        errors[beta] = float((mean(x).mean(0) - y)[jump].square().mean().sqrt())
        std = Noise(noisy, torch.ones(1)).std(x)[:, 0]
        assert float(std[jump].mean()) > float(std[~jump].median()), "noise is learned with each beta"
    assert errors[1.0] < 0.5 * errors[0.0]


def test_process_noise_shifts_ensemble_steps_by_the_learned_noise(model):
    steps, able = random_steps(pendulum(), 10, seed=3), offers(model, LearnedNoise)
    assert able is not None
    assert 0 < able.noise_stds[1] < 0.5 * float(model.scales[1])
    assert able.noise_stds[-1] == 0, "that of the reward is not learned"
    still, moved = (model.transition(steps.q, steps.u, process=torch.full((10, 2), w).double()) for w in (0.0, 1.0))
    assert torch.equal(still.q_next, model.transition(steps.q, steps.u).q_next)
    shift = moved.q_next[:, 1] - still.q_next[:, 1]
    assert float(shift.square().mean().sqrt()) == pytest.approx(able.noise_stds[1], rel=0.5)
    paths = torch.ones(10, 1, dtype=torch.float64)
    along = [model.transition_along(paths, steps.q, steps.u, process=p).q_next[:, 1] for p in (None, torch.ones(10, 2))]
    torch.testing.assert_close(along[1] - along[0], shift)


def test_an_ensemble_file_with_negative_noise_is_refused(model, definition):
    noise = replace(model.transitions.noise, size=-model.transitions.noise.size)
    data = to_bytes(replace(model, transitions=replace(model.transitions, noise=noise)))
    with pytest.raises(InvalidInput, match=r"transitions\.noise: expected each entry of size"):
        from_bytes(definition, data)


def test_an_ensemble_file_with_a_termination_label_other_than_0_or_1_is_refused():
    spec = pendulum().model_copy(update={"termination": "learned"})
    model = ensemble(spec, steps=20)
    assert model.ending == 0.0
    assert from_bytes(model.definition, to_bytes(model)).ending == 0.0
    with pytest.raises(InvalidInput, match=r"ending: expected 0 or 1, .* got 0\.5"):
        from_bytes(model.definition, with_header(model, ending=0.5))


def test_an_ensemble_file_with_too_many_members_is_refused(model, definition):
    few = model.transitions.networks
    networks = type(few)(*(weights.repeat(5, 1, 1) for weights in vars(few).values()))
    data = to_bytes(replace(model, transitions=replace(model.transitions, networks=networks)))
    with pytest.raises(InvalidInput, match="expected 2 to 16 networks"):
        from_bytes(definition, data)
