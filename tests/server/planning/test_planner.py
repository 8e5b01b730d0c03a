"""A planner: values on a grid keep the Bellman equation, plans hold what is unstable, misfits are refused."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from support import limited
from support.hinge import Real, Textbook, hinge_spec, steps_of
from support.models import learn
from support.real_steps import random_steps
from surrogym_sampler.original.classic import acrobot, cartpole, pendulum
from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.original.mujoco_tasks import reacher
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples
from surrogym_server.errors import InvalidInput
from surrogym_server.local import LocalSurrogate
from surrogym_server.models.gaussian_process.family import GaussianProcesses
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.planning import planner_of
from surrogym_server.planning.grid import GridModel, _nodes, solve
from surrogym_server.planning.pending import PendingActions
from surrogym_server.planning.planner import Decisions
from surrogym_shared.nouns import RealSteps
from surrogym_shared.spec import (
    DeclaredReward,
    EnvironmentSpec,
    Limits,
    Quantity,
    RewardTerm,
    Term,
    Uniform,
    with_history,
)
from surrogym_trainer.deployment.controller import NotDeployable
from surrogym_trainer.deployment.reading import controller_of
from surrogym_trainer.evaluation import imagined_returns
from surrogym_trainer.evaluation.imagined import imagine
from surrogym_trainer.evaluation.promise import promise_of
from surrogym_trainer.policies import load_policy
from surrogym_trainer.policies.card import UnusablePolicy, read_card
from surrogym_trainer.policies.files import load_learner
from surrogym_trainer.training import TrainSettings, train
from surrogym_trainer.training.words import words_of_result

NONE = np.empty((0, 2), dtype=np.int64)  # no action is late


def local(spec, steps: int) -> LocalSurrogate:
    return LocalSurrogate(spec, learn(definition_from_spec(spec), random_steps(spec, steps, seed=0)).model)


@pytest.fixture(scope="module")
def hanging() -> LocalSurrogate:
    return local(pendulum().model_copy(update={"time_limit": 60}), 25)


@pytest.fixture(scope="module")
def falling() -> LocalSurrogate:
    return local(cartpole().model_copy(update={"time_limit": 100}), 40)


def bilinear(policy, q: np.ndarray) -> np.ndarray:
    """The values (n,) at states (n, 2) of a pendulum, whose angle is cyclic."""
    low, cell, count, _ = policy.grid
    at = (q - low) / cell
    at[:, 0] %= count[0]
    at[:, 1] = at[:, 1].clip(0, count[1] - 1)
    first = np.minimum(at.astype(int), count - [1, 2])
    share = at - first
    table = policy.values.reshape(count[1], count[0])
    (i, j), (a, b) = first.T, share.T
    k = (i + 1) % count[0]
    return (1 - b) * ((1 - a) * table[j, i] + a * table[j, k]) + b * ((1 - a) * table[j + 1, i] + a * table[j + 1, k])


def test_values_on_the_grid_keep_the_bellman_equation(hanging: LocalSurrogate):
    steps = hanging.model.compiled()
    policy = solve(PendingActions.of(steps), hanging.model.terminal_reward, 60)
    nodes = _nodes(*policy.grid[:3])
    chosen = np.random.default_rng(0).choice(len(nodes), 500, replace=False)
    best = np.full(500, -np.inf)
    for force in np.linspace(-2, 2, 5):
        moved = steps(
            nodes[chosen],
            np.full((500, 1), force),
            noise=None,
            process=None,
            paths=None,
            stds=False,
            reward_std=False,
        )
        best = np.maximum(best, moved.reward + policy.discount * bilinear(policy, moved.q_next))
    apart = np.abs(best - policy.values[chosen])
    assert apart.max() < 0.02 * np.ptp(policy.values)


def test_a_planner_earns_more_than_the_policy_on_its_grid_and_far_more_than_nothing(hanging: LocalSurrogate):
    planner = hanging.planner(20)
    idle = imagined_returns(hanging, lambda o: np.zeros((len(o), 1)), 8, seed=0).mean()
    planned = imagined_returns(hanging, planner, 8, seed=0).mean()
    assert planned > 0.5 * idle  # costs are negative


def test_planned_discrete_actions_hold_an_unstable_pole(falling: LocalSurrogate):
    planner = falling.planner(10)
    shown = np.zeros((1, 4), dtype=np.float32)
    assert planner(shown).shape == (1,)
    assert planner(shown).dtype == np.int64
    assert imagined_returns(falling, planner, 4, seed=0).min() == 100


def test_a_planner_that_knows_the_noise_of_sensors_filters_what_it_measures(falling: LocalSurrogate):
    noise = dict(zip(falling.spec().coordinate_names, (0.1, 0.5, 0.05, 0.6), strict=True))
    raw, filtered = (
        imagined_returns(falling, falling.planner(10, sensor_noise=known), 16, seed=0, sensor_noise=noise).mean()
        for known in ({}, noise)
    )
    assert filtered > 1.3 * raw, "95 and 56 steps"


def decided(state: list[float], arrived: list[float], offset: Sequence[float] = (0.0, 0.0)) -> Decisions:
    """What a planner kept of a decision at one state, with a horizon of 5."""
    made = Decisions.none(2, 5, 1, 1)
    return replace(made, states=np.array([state]), arrived=np.array([arrived]), offsets=np.array([offset]))


def test_a_plan_is_continued_only_from_the_state_that_it_predicted(hanging: LocalSurrogate):
    planner = hanging.planner(5)
    planner._last = replace(decided([3.1, 1.0], [3.1, 1.0]), plans=np.arange(5.0).reshape(1, 5, 1))
    near, wrapped, far = planner._continued(np.array([[3.0, 1.1], [-3.1, 1.0], [1.0, 1.0]])).plans[:, :, 0]
    assert near.tolist() == wrapped.tolist() == [1, 2, 3, 4, 0]
    assert far.tolist() == [0, 0, 0, 0, 0]


def test_an_error_at_rest_changes_the_estimate_one_in_motion_keeps_it_and_a_reset_clears_it(hanging: LocalSurrogate):
    planner = hanging.planner(5)
    planner._last = decided([3.14, 0.0], [3.1, 0.0], offset=[0.01, 0.0])
    assert planner._continued(np.array([[-3.1, 0.0]])).offsets[0].tolist() == pytest.approx([0.01 + 0.00831853, 0])
    planner._last = decided([2.8, 0.0], [3.1, 0.0], offset=[0.01, 0.0])
    assert planner._continued(np.array([[-3.1, 0.0]])).offsets.tolist() == [[0.01, 0]]
    assert planner._continued(np.array([[0.0, 0.0]])).offsets.tolist() == [[0, 0]]


def test_rollouts_add_the_estimated_error_to_each_predicted_change(hanging: LocalSurrogate):
    planner, start = hanging.planner(5), np.array([0.5, 1.0])
    unchanged = np.zeros((1, 4, 5, 1))
    arrivals = [
        hanging.model.planned(planner.policy, start, np.array(offset), NONE, False, unchanged, 1, np.zeros((5, 1)))[1]
        for offset in ([0.0, 0.0], [0.02, -0.3])
    ]
    # The angle moves by 0.05 times the next speed, which the error changes too.
    assert (arrivals[1] - arrivals[0]).tolist() == pytest.approx([0.02 - 0.05 * 0.3, -0.3], abs=1e-3)


def hinge_samples(plant: Textbook, count: int) -> Samples:
    return Samples.of(RealSteps.of(steps_of(plant, count), "manual"))


def beside(*priors: Textbook) -> GaussianProcessModel:
    """A hinge's model of ten steps beside a prior, which may have a prior itself."""
    definition, family = definition_from_spec(hinge_spec()), GaussianProcesses()
    model: Any = family.learn(definition, hinge_samples(priors[0], 60)).model
    for plant in (*priors[1:], Real()):
        model = family.learn_beside(model, definition, hinge_samples(plant, 10)).model
    return model


def test_rollouts_add_the_prediction_of_a_prior_model():
    model, start, unchanged = beside(Textbook()), np.array([0.5, 1.0]), np.zeros((1, 2, 2, 1))
    policy, offset = planner_of(model, 2).policy, np.array([0.01, 0.2])
    action, arrival = model.planned(policy, start, offset, NONE, False, unchanged, 1, np.zeros((2, 1)))
    assert model.prior is not None
    at = torch.tensor(start[None]), torch.tensor(action[None])
    beside_it, alone = (one.transition(*at).q_next[0].numpy() for one in (model, model.prior))
    assert (arrival - beside_it).tolist() == pytest.approx(offset.tolist(), abs=1e-3)
    assert abs(beside_it[1] - alone[1]) > 0.1


def test_a_planner_beside_a_prior_model_earns_what_one_of_many_samples_does():
    few, many = beside(Textbook()), learn(definition_from_spec(hinge_spec()), hinge_samples(Real(), 60)).model
    returns = [
        imagined_returns(LocalSurrogate(hinge_spec(), many), LocalSurrogate(hinge_spec(), one).planner(8), 8, 0).mean()
        for one in (few, many)
    ]
    assert returns[0] == pytest.approx(returns[1], rel=0.1)


def test_a_prior_model_with_a_prior_is_refused():
    with pytest.raises(InvalidInput, match="beside at most one prior"):
        planner_of(beside(Textbook(), Textbook()), 5)


class Paying:
    """Compiled steps that pay 20 more for each step."""

    def __init__(self, steps) -> None:
        self.steps, self.definition = steps, steps.definition

    def __call__(self, q, u, **options):
        moved = self.steps(q, u, **options)
        return replace(moved, reward=moved.reward + 20)


def test_a_constant_added_to_all_rewards_adds_the_same_to_the_values_of_all_nodes(hanging: LocalSurrogate):
    steps: Any = hanging.model.compiled()
    plain, paid = (solve(PendingActions.of(s), 0.0, 60) for s in (steps, Paying(steps)))  # type: ignore[arg-type]
    assert np.ptp(paid.values - plain.values) < 0.02 * np.ptp(plain.values)
    from_zero = GridModel.of(PendingActions.of(Paying(steps)), 0.0).policy(paid.discount)  # type: ignore[arg-type]
    assert np.ptp(from_zero.values - plain.values) > 0.2 * np.ptp(plain.values), "values that begin at 0 need the bound"


def cart(limited_to: Limits | None) -> LocalSurrogate:
    """A cart that earns the more the further it goes to the right, where its rail ends."""
    rng, spec = np.random.default_rng(0), limited.with_limits(limited_to)
    q, u = rng.uniform((-1.5, -3), (1.5, 3), (40, 2)), rng.uniform(-1, 1, (40, 1))
    speed = q[:, 1] + u[:, 0] / 2
    after = np.stack([q[:, 0] + speed / 10, speed], 1)
    samples = Samples(*map(torch.tensor, (q, u, after, after[:, 0], np.zeros(40, dtype=bool))))
    return LocalSurrogate(spec, learn(definition_from_spec(spec), samples).model)


def test_a_planner_keeps_away_from_declared_limits_and_passes_them_where_none_are_declared():
    kept, free = cart(limited.LIMITS), cart(None)
    imagined = imagine(kept, kept.planner(5), 8, 0)
    assert imagined.left is not None
    assert not imagined.left.any()
    assert imagined_returns(free, free.planner(5), 8, 0).mean() > 2 * imagined.returns.mean() > 20
    planner, episode = kept.planner(5), open_episode("cart:Cart", None, limited.PatientCart)
    moment = episode.reset(0)
    for _ in range(40):
        moment = episode.step(planner.from_states(moment.coordinates[None])[0])
        assert not moment.fell_back
    assert moment.coordinates[0] > 0.3


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("threads")
def test_a_planner_acts_alike_in_any_number_of_threads(hanging: LocalSurrogate):
    states, found = np.random.default_rng(0).uniform(-1, 1, (30, 2)), []
    for count in (1, 3):
        torch.set_num_threads(count)
        planner = hanging.planner(5, 0)
        found += [planner.from_states(states), planner.from_states(states)]
    for one, several in zip(found[:2], found[2:], strict=True):
        np.testing.assert_array_equal(one, several)


def test_equal_planners_act_alike_and_other_seeds_try_other_changes(hanging: LocalSurrogate):
    shown = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    first, again, other = (hanging.planner(5, seed)(shown) for seed in (0, 0, 1))
    assert first.tolist() == again.tolist() != other.tolist()
    assert np.abs(first).max() <= 2


@pytest.mark.parametrize("horizon", [0, 201, 2.5, True])
def test_a_horizon_out_of_its_range_is_refused(hanging: LocalSurrogate, horizon):
    with pytest.raises(InvalidInput, match="horizon: expected a whole number of steps from 1 to 200, got"):
        hanging.planner(horizon)


def refused(spec: EnvironmentSpec, said: str) -> None:
    """The definition alone is refused, before the model is looked at."""
    model: Any = SimpleNamespace(definition=definition_from_spec(spec))
    with pytest.raises(InvalidInput, match=re.escape(said)):
        planner_of(model, 20)


def test_an_environment_with_too_many_coordinates_is_refused():
    refused(
        reacher(),
        "a planner needs at most 4 coordinates that repeat no action, got 6: train a network (--algorithm fastppo)",
    )


def test_a_coordinate_that_the_observation_does_not_show_is_named():
    spec = acrobot()
    blind = spec.model_copy(update={"observation": spec.observation[:5]})
    refused(blind, "coordinate 'speed2' can't be computed from the observation")


def test_an_action_with_a_rate_is_refused():
    resets = pendulum().model_copy(update={"query": "rollout"})
    rated = with_history(resets, actions=1, rate=(4.0,))
    refused(rated, "a planner needs an action without rate: train a network (--algorithm fastppo)")


def test_a_training_by_planner_writes_a_file_that_any_reader_of_policies_runs(hanging: LocalSurrogate, tmp_path):
    settings = TrainSettings(algorithm="planner", seed=3, hyperparameters={"horizon": 5})
    result = train(hanging, tmp_path / "planner.zip", settings)
    shown = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    assert load_policy(result.path, result.algorithm)(shown).tolist() == hanging.planner(5, 3)(shown).tolist()
    assert result.settings["horizon"] == 5
    assert result.imagined_return < 0
    assert words_of_result(result).startswith(f"{result.path}: made without training in ")
    with pytest.raises(UnusablePolicy, match="is a planner, which has no network"):
        load_learner(result.path, "PPO")
    with pytest.raises(NotDeployable, match="is a planner, which has no network; a deterministic feed-forward"):
        controller_of(result.path, pendulum())


def turning(speed: float) -> EnvironmentSpec:
    """A pendulum that is to turn at a speed."""
    error = Quantity(term=Term.linear(speed=0.5) + Term.constant(-0.5 * speed))
    reward = DeclaredReward(kind="declared", terms=(RewardTerm(shape="bump", of=(error,)),))
    return pendulum().model_copy(update={"time_limit": 30, "reward": reward})


def idle(observations):
    return np.zeros((len(observations), 1))


def test_a_set_point_at_run_time_plans_as_a_model_with_a_specification_of_it(tmp_path):
    plain, points = local(turning(1.0), 25), {"speed": -2.0}
    own = LocalSurrogate.from_bytes(turning(-2.0), plain.model_file())
    shown = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    expected = own.planner(5, 3)(shown).tolist()
    assert plain.planner(5, 3, points)(shown).tolist() == expected != plain.planner(5, 3)(shown).tolist()

    settings = TrainSettings(
        algorithm="planner", seed=3, session={"set_points": points}, hyperparameters={"horizon": 5}
    )
    result = train(plain, tmp_path / "planner.zip", settings)
    assert load_policy(result.path)(shown).tolist() == expected
    assert read_card(result.path).set_points == points
    assert result.imagined_return == train(own, tmp_path / "own.zip", replace(settings, session={})).imagined_return
    assert promise_of(plain, idle, 0, {"set_points": points}) == promise_of(own, idle, 0) != promise_of(plain, idle, 0)

    far = replace(settings, session={"set_points": {"speed": 99.0}})
    with pytest.raises(ValueError, match="set point 'speed': expected a number in the sampling range"):
        train(plain, tmp_path / "far.zip", far)
    assert not (tmp_path / "far.zip").exists()


STEP = np.array([[1.0, 0.1, 0.05], [0.0, 1.0, 0.5]])  # of the cart of tests/support/limited.py


def way_of(planner) -> np.ndarray:
    """The states (T + 1, C) of an episode of the cart with a planner from rest."""
    path = [np.zeros(2)]
    for _ in range(40):
        path.append(STEP @ np.concatenate([path[-1], planner.from_states(path[-1][None])[0]]))
    return np.array(path)


def test_a_planner_keeps_limits_at_run_time_that_its_reward_contradicts(tmp_path):
    free, limits = cart(None), ("x<=0.8", "0.1*x+v<=0.5")
    plain, kept = way_of(free.planner(10, 3)), way_of(free.planner(10, 3, limits=limits))
    assert plain[:, 0].max() > 1.2
    assert plain[:, 1].max() > 1
    assert 0.6 < kept[:, 0].max() <= 0.8
    assert 0.3 < (kept @ [0.1, 1.0]).max() <= 0.5
    both = way_of(cart(limited.LIMITS).planner(10, 3, limits=["x<=0.3"]))
    assert 0.2 < both[:, 0].max() <= 0.3, "besides those of the specification"

    settings = TrainSettings(algorithm="planner", seed=3, hyperparameters={"horizon": 10, "limits": list(limits)})
    result = train(free, tmp_path / "planner.zip", settings)
    assert way_of(load_policy(result.path)).tolist() == kept.tolist()
    assert read_card(result.path).limits == limits
    with zipfile.ZipFile(result.path) as file:
        assert json.loads(file.read("surrogym-planner.json"))["version"] == 2, "others would not keep the limits"


@pytest.mark.parametrize(
    ("limit", "said"),
    [
        ("speed<=0.5", "expected every start to be inside by at least 0.16"),
        ("speed<=2", r"but each of 4 virtual episodes left it, by up to [0-9.]+: choose a wider limit"),
    ],
)
def test_a_limit_that_can_not_be_kept_is_refused_and_leaves_no_file(hanging: LocalSurrogate, tmp_path, limit, said):
    starts = {"theta": Uniform(low=1.4, high=1.6), "speed": Uniform(low=0.4, high=0.6)}
    falling = LocalSurrogate.from_bytes(hanging.spec().model_copy(update={"start": starts}), hanging.model_file())
    settings = TrainSettings(algorithm="planner", hyperparameters={"limits": [limit]})
    with pytest.raises(ValueError, match=f"PLANNER: limit '{limit}': .*{said}"):
        train(falling, tmp_path / "planner.zip", settings)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("limits", ["speed<=2", ["speed<=2"] * 17])
def test_limits_that_are_no_list_or_too_many_are_refused(hanging: LocalSurrogate, tmp_path, limits):
    settings = TrainSettings(algorithm="planner", hyperparameters={"limits": limits})
    with pytest.raises(ValueError, match="PLANNER: expected limits as a list of at most 16 texts, got"):
        train(hanging, tmp_path / "planner.zip", settings)


def test_a_planner_that_can_not_be_made_leaves_no_file(hanging: LocalSurrogate, tmp_path):
    settings = TrainSettings(algorithm="planner", hyperparameters={"horizon": 0})
    with pytest.raises(ValueError, match="algorithm PLANNER: horizon: expected"):
        train(hanging, tmp_path / "planner.zip", settings)
    assert not list(tmp_path.iterdir())


def test_a_damaged_planner_is_refused_in_words(hanging: LocalSurrogate, tmp_path):
    path = train(hanging, tmp_path / "planner.zip", TrainSettings(algorithm="planner")).path
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 255
    path.write_bytes(content)
    with pytest.raises(UnusablePolicy, match=r"planner.zip"):
        load_policy(path)
