"""Networks with Bayesian last layers: draws have the mean and deviation of the model, the deviation grows away from the
samples, odd files and settings are refused."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from support.models import learn, with_header
from support.real_steps import random_steps
from surrogym_client.original.classic import cartpole, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.errors import InvalidInput, InvalidSpec
from surrogym_server.models.abilities import PredictedSteps
from surrogym_server.models.bayesian_last_layer import training
from surrogym_server.models.bayesian_last_layer.model import BayesianLastLayerModel
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.port import Learned
from surrogym_server.models.registry import learner_of
from surrogym_server.plugins import Choice
from surrogym_shared.spec import EnvironmentSpec, ModelChoice

SETTINGS = {"networks": 2, "units": 12, "waves": 24, "iterations": 80}
DRAWS = 4_000


def fitted(spec: EnvironmentSpec, samples: int = 24, warm: Learned | None = None, **settings: int) -> Learned:
    chosen = ModelChoice(name="bayesian_last_layer", settings=SETTINGS | settings)
    spec = spec.model_copy(update={"design": spec.design.model_copy(update={"model": chosen})})
    before = None if warm is None else warm.warm
    return learn(definition_from_spec(spec), random_steps(spec, samples, seed=0), before)


def layers(spec: EnvironmentSpec, samples: int = 24, **settings: int) -> BayesianLastLayerModel:
    model = fitted(spec, samples, **settings).model
    assert isinstance(model, BayesianLastLayerModel)
    return model


@pytest.fixture(scope="module")
def model() -> BayesianLastLayerModel:
    return layers(pendulum())


@pytest.fixture(scope="module")
def definition(model) -> EnvironmentDefinition:
    return model.definition


def test_draws_have_the_mean_and_the_deviation_of_the_model(model):
    steps = random_steps(pendulum(), 3, seed=5)
    noise = torch.randn(DRAWS, model.path_size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    paths = model.draw(noise)
    for q, u in zip(steps.q, steps.u, strict=True):
        q, u = 0.5 * q[None], u[None]
        made = model.transition(q, u, deviations=True, reward_deviation=True)
        drawn = model.transition_along(paths, q.expand(DRAWS, -1), u.expand(DRAWS, -1))
        deviation = float(made.deviation[0, 1])
        off = float(drawn.q_next[:, 1].mean() - made.q_next[0, 1])
        assert abs(off) < 5 * deviation / DRAWS**0.5
        assert float(drawn.q_next[:, 1].std()) == pytest.approx(deviation, rel=0.1)


def test_a_draw_keeps_its_member_and_weights_at_every_state(model):
    """A drawn function is the linear function of its own member's features."""
    steps = random_steps(pendulum(), 6, seed=4)
    noise = torch.randn(1, model.path_size, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    path = model.draw(noise)
    member, weights = int(path[0, 0]), path[0, 1 : 1 + model.transitions.size].reshape(2, -1)
    phi = model.transitions.phi(model._inputs.of_transition(steps.q, steps.u))[member]
    values = model.transitions.centre + model.transitions.scale * (phi @ weights[..., None])[..., 0].T
    along = model.transitions.along(
        model.transitions.phi(model._inputs.of_transition(steps.q, steps.u)),
        torch.full((6,), member),
        path[:, 1 : 1 + model.transitions.size].expand(6, -1),
    )
    torch.testing.assert_close(along, values)


def test_deviations_grow_away_from_the_samples(model):
    steps = random_steps(pendulum(), 24, seed=0)
    near = model.transition(steps.q, steps.u, deviations=True).deviation
    deviations = []
    for speed in (12.0, 24.0, 60.0):
        far = torch.tensor([[0.5, speed]], dtype=torch.float64)
        deviations.append(float(model.transition(far, steps.u[:1], deviations=True).deviation[0, 1]))
    assert deviations[0] > 3 * float(near[:, 1].median())
    assert deviations == sorted(deviations)


def test_the_same_seed_gives_the_same_model_and_another_seed_another(model):
    assert to_bytes(layers(pendulum())) == to_bytes(model)
    assert not torch.equal(layers(pendulum(), seed=7).transitions.mean, model.transitions.mean)


def test_a_loaded_model_draws_and_differentiates_to_the_same_bits(model, definition):
    loaded = from_bytes(definition, to_bytes(model))
    assert isinstance(loaded, BayesianLastLayerModel)
    noise = torch.randn(5, model.path_size, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert torch.equal(loaded.draw(noise), model.draw(noise))
    assert loaded.leave_one_out() == model.leave_one_out()
    assert loaded.noise_deviations == model.noise_deviations
    steps = random_steps(pendulum(), 5, seed=2)
    gradients = []
    for one in (model, loaded):
        u = steps.u.clone().requires_grad_()
        gradients.append(torch.autograd.grad(one.transition(steps.q, u).q_next.sum(), u)[0])
    assert torch.equal(*gradients)


def test_a_warm_start_takes_fewer_steps_and_other_shapes_are_ignored(monkeypatch):
    taken = []
    descend = training._descend
    monkeypatch.setattr(training, "_descend", lambda *given: (taken.append(given[2]), descend(*given))[1])
    first = fitted(pendulum())
    fitted(pendulum(), warm=first)
    fitted(pendulum(), warm=first, units=8)
    assert taken == [80, 80, 27, 27, 80, 80]


def test_very_many_samples_are_learned_from_in_batches(monkeypatch):
    monkeypatch.setattr(training, "LARGEST_BATCH", 50)
    monkeypatch.setattr(training, "ROWS", 70)
    steps = random_steps(pendulum(), 30, seed=9)
    made = layers(pendulum(), samples=200)
    off = made.transition(steps.q, steps.u).q_next[:, 1] - steps.q_next[:, 1]
    assert float(off.square().mean().sqrt()) < 0.1 * float((steps.q_next - steps.q)[:, 1].std())


def test_an_output_that_never_varied_is_constant_and_certain():
    made = layers(cartpole())
    steps = random_steps(cartpole(), 5, seed=9)
    moved = made.transition(steps.q, steps.u, reward_deviation=True)
    assert made.structures[-1] == "constant"
    assert (moved.reward.tolist(), moved.reward_deviation.tolist()) == ([1.0] * 5, [0.0] * 5)
    assert made.leave_one_out()[-1].error == 0


def test_answered_steps_leave_the_means_and_shrink_the_deviations(model):
    points = random_steps(pendulum(), 4, seed=6)
    q_next = model.transition(points.q, points.u).q_next
    after = model.as_if_answered(PredictedSteps(points.q, points.u, q_next))
    assert torch.equal(after.means(points.q, points.u), model.means(points.q, points.u))
    everywhere = random_steps(pendulum(), 40, seed=8)
    before, now = (m.transition(everywhere.q, everywhere.u, deviations=True).deviation for m in (model, after))
    assert bool((now <= before + 1e-12).all())


def test_an_outlook_of_one_network_is_that_of_the_answered_model():
    """With a single network the mixture is normal, so a forecast and the conditioned model agree."""
    made = layers(pendulum(), networks=1)
    steps = random_steps(pendulum(), 12, seed=3)
    points = Points(0.5 * steps.q, steps.u)
    q_next = made.transition(points.q, points.u).q_next
    assumed = PredictedSteps(points.q[2:3], points.u[2:3], q_next[2:3])
    after = made.as_if_answered(assumed).transition(points.q, points.u, deviations=True).deviation
    forecast = made.outlook(points, points[:3], points[:0])[1].observe(2).deviation
    torch.testing.assert_close(forecast, after[:, 1], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"networks": 0}, "networks to be a whole number from 1 to 16, got 0"),
        ({"units": 1.5}, "expected units to be a whole number, got 1.5"),
        ({"waves": -1}, "waves to be a whole number from 0 to 256, got -1"),
        ({"iterations": True}, "expected iterations to be a whole number, got True"),
        ({"seed": -1}, "seed to be a whole number"),
        ({"members": 3}, "expected a setting out of networks, units, waves, iterations, seed, got 'members'"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, said):
    with pytest.raises(InvalidSpec, match=said):
        learner_of(Choice("bayesian_last_layer", tuple(settings.items())))


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ({"format": 2}, "expected a model of format 1"),
        ({"outputs": ["theta", "reward"]}, "with outputs"),
        ({"samples": 0}, "finite terminal reward and samples"),
        ({"family": "ensemble"}, "family 'bayesian_last_layer', as the specification says, got one of 'ensemble'"),
    ],
)
def test_a_header_that_contradicts_the_environment_is_refused(model, definition, header, said):
    with pytest.raises(InvalidInput, match=said):
        from_bytes(definition, with_header(model, **header))


@pytest.mark.parametrize(
    ("part", "value", "said"),
    [
        ("noise", 0.0, "expected noise above 0"),
        ("parts", -1.0, "expected parts above 0"),
        ("scale", -1.0, "expected scale of at least 0"),
        ("left_out", 2.0, "expected shares of left_out of at most 1"),
    ],
)
def test_numbers_that_no_fit_gives_are_refused(model, definition, part, value, said):
    odd = replace(model.transitions, **{part: torch.full_like(getattr(model.transitions, part), value)})
    with pytest.raises(InvalidInput, match=said):
        from_bytes(definition, to_bytes(replace(model, transitions=odd)))


def test_transition_and_reward_need_the_same_number_of_networks(model, definition):
    other = layers(pendulum(), networks=3, iterations=1)
    with pytest.raises(InvalidInput, match="reward: expected 2 members, got 3"):
        from_bytes(definition, to_bytes(replace(model, reward=other.reward)))
