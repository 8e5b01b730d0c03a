"""Declared rewards: the sums they say, no process, no deviation, no code."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from pydantic import ValidationError

from support.models import learn
from support.real_steps import random_steps
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_sampler.original.swingup import LENGTH, WIDTH, swing_up_narrow
from surrogym_server.convert import definition_from_spec
from surrogym_server.errors import InvalidInput
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.sampling.confidence import stds
from surrogym_shared.spec import DeclaredReward, EnvironmentSpec, Inequality, Quantity, RewardTerm, Term

ANGLE, SPEED = Quantity(term=Term.linear(theta=1)), Quantity(term=Term.linear(speed=1))
COST = DeclaredReward(
    kind="declared",
    terms=(
        RewardTerm(weight=-1.0, shape="square", of=(ANGLE,)),
        RewardTerm(weight=-0.1, shape="square", of=(SPEED,)),
        RewardTerm(weight=-0.001, shape="square", of=(Quantity(action=(1.0,)),)),
    ),
)
PENDULUM = pendulum().model_copy(update={"reward": COST})


def paying(*terms: RewardTerm, **options: Any) -> EnvironmentSpec:
    reward = DeclaredReward(kind="declared", terms=terms, **options)
    return EnvironmentSpec.model_validate(pendulum().model_copy(update={"reward": reward}).model_dump())


def value(spec: EnvironmentSpec, q: list[float], u: list[float]) -> float:
    known = definition_from_spec(spec).declared_reward
    assert known is not None
    return float(known(torch.tensor([q]).double(), torch.tensor([u]).double()))


@pytest.fixture(scope="module")
def model() -> GaussianProcessModel:
    return learn(definition_from_spec(PENDULUM), random_steps(PENDULUM, 12, seed=0)).model


def test_a_declared_pendulum_reward_is_predicted_exactly_without_uncertainty(model):
    steps = random_steps(PENDULUM, 100, seed=1)
    predicted = model.transition(steps.q, steps.u, reward_std=True)
    torch.testing.assert_close(predicted.reward, steps.reward, rtol=0, atol=1e-6)
    assert float(predicted.reward_std.max()) == 0
    torch.testing.assert_close(model.means(steps.q, steps.u)[:, -1], steps.reward, rtol=0, atol=1e-6)
    assert float(stds(model, steps.q, steps.u)[:, -1].max()) == 0
    described = model.description["outputs"][-1]
    assert described["kernel"] == "declared"
    assert described["scores"]["declared, largest error over the samples"] < 1e-6


def test_rewards_that_contradict_the_declared_formula_are_reported_in_the_description(model):
    steps = random_steps(PENDULUM, 12, seed=0)
    off = learn(model.definition, replace(steps, reward=steps.reward + 2)).model
    assert off.description["outputs"][-1]["scores"]["declared, largest error over the samples"] == pytest.approx(2)


def test_each_shape_of_a_declared_reward_term_has_its_value():
    x, push = Quantity(term=Term.linear(speed=2)), Quantity(term=Term.constant(1), action=(3.0,))
    q, u = [0.0, -0.5], [1.0]  # x = -1, push = 4
    assert value(paying(RewardTerm(shape="one", weight=2)), q, u) == 2
    assert value(paying(RewardTerm(shape="linear", of=(x, push))), q, u) == 3
    assert value(paying(RewardTerm(shape="absolute", of=(x, push))), q, u) == 5
    assert value(paying(RewardTerm(shape="square", of=(x, push))), q, u) == 17
    bump = RewardTerm(shape="bump", weight=2, of=(x, Quantity(action=(2.0,))))
    assert value(paying(bump), q, u) == pytest.approx(2 * math.exp(-0.5 * (1 + 4)))
    assert value(paying(bump, RewardTerm(shape="one", weight=-1)), q, u) == pytest.approx(2 * math.exp(-2.5) - 1)
    small = Quantity(term=Term.linear(speed=1), action=(0.8,))  # 0.3 with this action
    ball = paying(RewardTerm(shape="ball", weight=2, of=(small, Quantity(term=Term.linear(speed=1.9)))))
    assert [value(ball, q, [push]) for push in (1.0, 0.0)] == [2, 0]  # 0.09 + 0.9025 <= 1 < 0.25 + 0.9025


@pytest.mark.parametrize("actions", [1, 2])
def test_a_declared_reward_of_a_state_threshold_does_not_depend_on_the_number_of_actions(actions: int):
    """A reward of two values that was found has conditions, and no quantity whose weights name the actions."""
    fast = Inequality(term=Term.linear(speed=1), relation=">=", value=1.0)
    spec = paying(RewardTerm(shape="one", when=(fast,)))
    for speed, paid in ((0.5, 0.0), (1.5, 1.0)):
        assert value(spec, [0.0, speed], [0.3] * actions) == paid


def test_a_declared_reward_term_counts_only_when_its_conditions_hold():
    near = Inequality(term=Term.linear(theta=1), relation=">=", value=0.5)
    slow = Inequality(term=Term.linear(speed=1), relation="<", value=1)
    spec = paying(RewardTerm(shape="one", weight=5, when=(near, slow)), RewardTerm(shape="one", weight=-1))
    assert [value(spec, q, [0.0]) for q in ([0.5, 0.0], [0.4, 0.0], [0.5, 1.0])] == [4, -1, -1]


def test_a_declared_reward_can_read_the_next_state_and_add_a_terminal_reward():
    end = Inequality(term=Term.linear(x=1), relation=">", value=2.4)
    reward = DeclaredReward(
        kind="declared",
        timing="after",
        terminal=-10,
        terms=(RewardTerm(shape="linear", of=(Quantity(term=Term.linear(x=1)),)),),
    )
    spec = cartpole().model_copy(update={"reward": reward, "termination": ((end,),)})
    model = learn(definition_from_spec(spec), random_steps(spec, 12, seed=0)).model
    q = torch.tensor([[1.0, 2.0, 0, 0], [2.39, 3.0, 0, 0]], dtype=torch.float64)
    u = torch.ones(2, 1, dtype=torch.float64)
    predicted = model.transition(q, u)
    torch.testing.assert_close(predicted.reward, predicted.q_next[:, 0])
    assert model.means(q, u)[:, -1].tolist() == pytest.approx((predicted.q_next[:, 0] - torch.tensor([0, 10])).tolist())


def test_the_narrow_cart_pole_reward_of_pilco_can_be_declared():
    """exp(-d^2 / (2 width^2)), d from the pole's tip to where it stands above the origin."""
    width, length = WIDTH["narrow"], LENGTH
    across = Quantity(term=(1 / width) * (Term.linear(x=1) + length * Term.sin(angle=1)))
    below = Quantity(term=(length / width) * (Term.constant(1) + Term.cos(angle=1)))
    bump = RewardTerm(shape="bump", of=(across, below))
    reward = DeclaredReward(kind="declared", timing="after", terms=(bump,))
    spec = swing_up_narrow().model_copy(update={"reward": reward})
    steps = random_steps(spec, 100, seed=0)
    known = definition_from_spec(spec).declared_reward
    assert known is not None
    torch.testing.assert_close(known(steps.q_next, steps.u), steps.reward)
    assert float(steps.reward.max()) > 0.1


def test_a_model_with_declared_reward_survives_storage_and_one_with_learned_is_refused(model, pendulum_model):
    loaded = from_bytes(model.definition, to_bytes(model))
    assert loaded.description == model.description
    with pytest.raises(InvalidInput, match=r"learned reward, .* declared"):
        from_bytes(model.definition, to_bytes(pendulum_model))


def test_a_specification_with_declared_reward_survives_json():
    assert EnvironmentSpec.model_validate_json(PENDULUM.model_dump_json()) == PENDULUM
    old = pendulum().model_dump(mode="json")
    del old["reward"]["kind"]
    assert EnvironmentSpec.model_validate(old) == pendulum()


SQUARE = {"shape": "square", "of": [{"action": [1.0]}]}


@pytest.mark.parametrize(
    ("reward", "said"),
    [
        ({"kind": "guessed"}, "'learned', 'declared'"),
        ({"kind": "declared"}, "Field required"),
        ({"kind": "declared", "terms": []}, "at least 1 item"),
        ({"kind": "declared", "terms": [{"shape": "square"}]}, "needs quantities to measure"),
        ({"kind": "declared", "terms": [{**SQUARE, "shape": "one"}]}, "takes no quantities"),
        ({"kind": "declared", "terms": [{**SQUARE, "shape": "lambda q: q"}]}, "'one', 'linear'"),
        ({"kind": "declared", "terms": [{**SQUARE, "weight": math.nan}]}, "finite number"),
        ({"kind": "declared", "terms": [{**SQUARE, "of": [{}]}]}, "expected a term or weights"),
        ({"kind": "declared", "terms": [{**SQUARE, "of": [{"action": [1.0, 2.0]}]}]}, "expected 1 weights"),
        ({"kind": "declared", "terms": [SQUARE], "timing": "auto"}, "'before' or 'after'"),
        ({"kind": "declared", "terms": [SQUARE], "penalty": 1.0}, "Extra inputs"),
        ({"kind": "declared", "terms": [SQUARE], "code": "1"}, "Extra inputs"),
        (
            {"kind": "declared", "terms": [{"shape": "square", "of": [{"term": Term.linear(y=1).model_dump()}]}]},
            r"unknown \['y'\]",
        ),
    ],
)
def test_invalid_declared_rewards_are_refused(reward, said):
    with pytest.raises(ValidationError, match=said):
        EnvironmentSpec.model_validate(pendulum().model_dump() | {"reward": reward})


def test_preset_paper_with_a_declared_reward_is_refused():
    design = {"preset": "paper"}
    with pytest.raises(ValidationError, match="learns its reward"):
        EnvironmentSpec.model_validate(PENDULUM.model_dump() | {"design": design})


@pytest.mark.parametrize("termination", ["guessed", "import os", [["learned"]], [[]], None])
def test_a_termination_other_than_learned_or_condition_groups_is_refused(termination):
    with pytest.raises(ValidationError, match="termination"):
        EnvironmentSpec.model_validate(pendulum().model_dump() | {"termination": termination})


def test_a_specification_with_learned_termination_has_no_condition_groups():
    learned = EnvironmentSpec.model_validate(pendulum().model_dump() | {"termination": "learned"})
    assert learned.termination == "learned"
    assert learned.termination_groups == ()
    assert EnvironmentSpec.model_validate_json(learned.model_dump_json()) == learned
