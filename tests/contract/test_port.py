"""The laws of SurrogatePort, for every implementation: what a trainer may rely on whatever carries its steps.

Shapes: N = 3 lanes, D = 3 observation entries, F = 1 action entry, O = 3 outputs; see ``harness`` in
conftest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from surrogym_shared.port import ResetResult, StepResult, SurrogatePort
from surrogym_shared.wire import OpenSession

N, D, O = 3, 3, 3  # noqa: E741
MODES = ["next_step", "same_step", "disabled"]
Opened = Callable[..., str]


@pytest.fixture
def port(harness) -> SurrogatePort:
    return harness.port


@pytest.fixture
def opened(port: SurrogatePort):
    """Opens sessions of N lanes with seed 7, and closes them at the end."""
    sessions = []

    def open_session(**options: Any) -> str:
        session = port.open(OpenSession(**{"num_envs": N, "seed": 7, **options})).id
        sessions.append(session)
        return session

    yield open_session
    for session in sessions:
        port.close(session)


def actions(steps: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-2, 2, (steps, N, 1)).astype(np.float32)


def assert_same(ours: ResetResult | StepResult, theirs: ResetResult | StepResult) -> None:
    """Bit for bit."""
    for field in fields(ours):
        our, their = getattr(ours, field.name), getattr(theirs, field.name)
        np.testing.assert_array_equal(our, their, err_msg=field.name, strict=our is not None)


# Opening


def test_an_opened_session_returns_its_settings(port: SurrogatePort):
    view = port.open(OpenSession(num_envs=2, seed=0, time_limit=9, penalty=1.5, autoreset_mode="same_step"))
    assert (view.num_envs, view.seed, view.time_limit, view.penalty) == (2, 0, 9, 1.5)
    assert view.autoreset_mode == "same_step"
    assert view.model_version == [1, 1]
    assert (view.action_space.low, view.action_space.high) == ([-2.0], [2.0])
    assert view.observation_space.high == [1.0, 1.0, 8.0]
    port.close(view.id)


def test_session_options_left_out_are_taken_from_the_specification(port: SurrogatePort):
    view = port.open(OpenSession())
    assert view.time_limit == port.spec().time_limit == 200
    port.close(view.id)


def test_opening_a_session_without_seed_returns_a_random_one(port: SurrogatePort):
    views = [port.open(OpenSession()) for _ in range(2)]
    assert views[0].seed != views[1].seed
    starts = [port.reset(view.id).observation for view in views]
    again = port.open(OpenSession(seed=views[0].seed))
    np.testing.assert_array_equal(port.reset(again.id).observation, starts[0])
    for view in (*views, again):
        port.close(view.id)


def test_opening_twice_with_one_idempotency_key_opens_one_session(port: SurrogatePort, harness):
    request = OpenSession(seed=1, idempotency_key=f"key of {harness.name}")
    first, second = port.open(request), port.open(request)
    assert first.id == second.id
    with pytest.raises(harness.errors.IdempotencyConflict):
        port.open(request.model_copy(update={"seed": 2}))
    port.close(first.id)


# Shapes and values


def test_session_results_have_the_declared_shapes_and_types(port: SurrogatePort, opened: Opened):
    session = opened()
    start = port.reset(session)
    result = port.step(session, actions(1)[0], deviations=True)
    shapes = {
        "observation": ((N, D), "f"),
        "reward": ((N,), "f"),
        "terminated": ((N,), "b"),
        "truncated": ((N,), "b"),
        "final_lanes": ((0,), "i"),
        "final_observation": ((0, D), "f"),
        "model_version": ((N,), "i"),
        "reward_mean": ((N,), "f"),
        "deviation": ((N, O), "f"),
    }
    found = {name: (getattr(result, name).shape, getattr(result, name).dtype.kind) for name in shapes}
    assert found == shapes
    assert start.observation.dtype == result.observation.dtype == np.float32
    assert result.reward.dtype == np.float64


def test_predictive_deviations_are_returned_only_on_request(port: SurrogatePort, opened: Opened):
    plain, asked = opened(), opened()
    assert_same(port.reset(plain), port.reset(asked))
    for action in actions(3):
        without, beside = port.step(plain, action), port.step(asked, action, deviations=True)
        assert without.deviation is None
        assert (beside.deviation >= 0).all()
        np.testing.assert_array_equal(without.observation, beside.observation)
        np.testing.assert_array_equal(without.reward, beside.reward)


def test_the_uncertainty_penalty_is_subtracted_from_the_mean_reward(port: SurrogatePort, opened: Opened):
    session = opened(penalty=2.0)
    port.reset(session)
    result = port.step(session, actions(1)[0], deviations=True)
    np.testing.assert_allclose(result.reward, result.reward_mean - 2.0 * result.deviation[:, -1], rtol=1e-9)
    assert (result.reward < result.reward_mean).all()


def test_one_dimensional_actions_may_be_given_as_a_flat_array(port: SurrogatePort, opened: Opened):
    first, second = opened(), opened()
    port.reset(first)
    port.reset(second)
    action = actions(1)[0]
    assert_same(port.step(first, action), port.step(second, action[:, 0]))


@pytest.mark.parametrize("mode", MODES)
def test_an_episode_is_truncated_where_the_model_is_too_uncertain(port: SurrogatePort, opened: Opened, mode: str):
    session = opened(trust=1e-9, autoreset_mode=mode)
    port.reset(session)
    result = port.step(session, actions(1)[0])
    assert result.untrusted.all()
    assert result.truncated.all()
    assert not result.terminated.any()
    assert result.deviation is None
    assert len(result.final_lanes) == (N if mode == "same_step" else 0)


def test_a_large_limit_on_the_models_uncertainty_ends_no_episode(port: SurrogatePort, opened: Opened):
    wide, none = opened(trust=1_000.0), opened()
    assert_same(port.reset(wide), port.reset(none))
    ours, theirs = port.step(wide, actions(1)[0]), port.step(none, actions(1)[0])
    assert ours.untrusted.dtype == np.bool_
    assert not ours.untrusted.any()
    assert theirs.untrusted is None
    assert ours.left is theirs.left is None, "neither an outside reward nor limits are declared"
    np.testing.assert_array_equal(ours.observation, theirs.observation)


# Seeds


@pytest.mark.parametrize("variant", ["deterministic", "probabilistic", "pathwise"])
def test_the_same_seeded_requests_give_the_same_replies(port: SurrogatePort, opened: Opened, variant: str):
    options = {"variant": variant, "time_limit": 4, "process_noise": True}
    options |= {"particles": 20} if variant == "probabilistic" else {}
    first, second = opened(**options), opened(**options)
    for seed in (0, None):
        assert_same(port.reset(first, seed=seed), port.reset(second, seed=seed))
        for action in actions(6):
            assert_same(port.step(first, action), port.step(second, action))


def test_a_reset_without_seed_starts_the_next_episode(port: SurrogatePort, opened: Opened):
    session = opened()
    episodes = []
    for _ in range(2):
        port.reset(session, seed=0)
        episodes.append([port.reset(session), port.step(session, actions(1)[0]), port.reset(session)])
    for first, second in zip(*episodes, strict=True):
        assert_same(first, second)
    assert not np.array_equal(episodes[0][0].observation, episodes[0][2].observation)


def test_the_first_reset_uses_the_seed_of_the_session(port: SurrogatePort, opened: Opened):
    assert_same(port.reset(opened(seed=0)), port.reset(opened(seed=5), seed=0))


def test_resetting_with_an_integer_seed_gives_every_environment_its_own_start(port: SurrogatePort, opened: Opened):
    observation = port.reset(opened(), seed=3).observation
    assert len(np.unique(observation, axis=0)) == N


def test_resetting_with_a_seed_list_starts_each_environment_by_its_own_seed(port: SurrogatePort, opened: Opened):
    session = opened()
    first = port.reset(session, seed=3).observation[0]
    observation = port.reset(session, seed=[3, 4, 3]).observation
    np.testing.assert_array_equal(observation[[0, 2]], [first, first])
    assert not np.array_equal(observation[1], first)


def test_a_start_state_does_not_depend_on_the_number_of_environments(port: SurrogatePort, opened: Opened):
    few, many = opened(num_envs=1), opened(num_envs=17)
    start = port.reset(few).observation[0]
    np.testing.assert_allclose(port.reset(many).observation[0], start, atol=1e-6)
    ours = port.step(few, np.ones((1, 1))).observation[0]
    theirs = port.step(many, np.ones((17, 1))).observation[0]
    np.testing.assert_allclose(ours, theirs, atol=1e-5)


# Masks


def test_a_masked_reset_leaves_the_other_environments_unchanged(port: SurrogatePort, opened: Opened):
    touched, undisturbed = opened(), opened()
    port.reset(touched)
    port.reset(undisturbed)
    first, second = actions(2)
    shown = port.step(touched, first)
    port.step(undisturbed, first)
    mask = np.array([False, True, False])
    result = port.reset(touched, mask=mask)
    np.testing.assert_array_equal(result.observation[~mask], shown.observation[~mask])
    assert not np.array_equal(result.observation[mask], shown.observation[mask])
    ours, theirs = port.step(touched, second), port.step(undisturbed, second)
    np.testing.assert_array_equal(ours.observation[~mask], theirs.observation[~mask])
    np.testing.assert_array_equal(ours.reward[~mask], theirs.reward[~mask])


def test_a_masked_step_leaves_the_other_environments_unchanged(port: SurrogatePort, opened: Opened):
    touched, undisturbed = opened(), opened()
    start = port.reset(touched)
    port.reset(undisturbed)
    mask = np.array([True, False, True])
    action = actions(1)[0]
    partial, full = port.step(touched, action, mask=mask), port.step(undisturbed, action)
    np.testing.assert_array_equal(partial.observation[~mask], start.observation[~mask])
    assert not partial.reward[~mask].any()
    assert not (partial.terminated | partial.truncated)[~mask].any()
    np.testing.assert_allclose(partial.observation[mask], full.observation[mask], atol=1e-5)
    late = port.step(touched, action, mask=~mask)
    np.testing.assert_allclose(late.observation[~mask], full.observation[~mask], atol=1e-5)


# Autoreset. All lanes reach the time limit at once; ``next_start`` is where their next episodes start.


def next_start(port: SurrogatePort, session: str) -> np.ndarray:
    port.reset(session)
    return port.reset(session).observation


def run_to_the_limit(port: SurrogatePort, session: str) -> list[StepResult]:
    port.reset(session)
    return [port.step(session, action) for action in actions(4)]


@pytest.mark.parametrize("mode", MODES)
def test_reaching_the_time_limit_truncates_and_does_not_terminate(port: SurrogatePort, opened: Opened, mode: str):
    results = run_to_the_limit(port, opened(time_limit=4, autoreset_mode=mode))
    assert [bool(r.truncated.any()) for r in results] == [False, False, False, True]
    assert results[-1].truncated.all()
    assert not any(r.terminated.any() for r in results)


def test_autoreset_mode_next_step_returns_the_new_start_in_the_following_step(port: SurrogatePort, opened: Opened):
    session = opened(time_limit=4, autoreset_mode="next_step")
    last = run_to_the_limit(port, session)[-1]
    following = port.step(session, actions(1, seed=5)[0])
    np.testing.assert_array_equal(following.observation, next_start(port, opened()))
    assert not following.reward.any()
    assert not (following.terminated | following.truncated).any()
    assert len(last.final_lanes) == len(following.final_lanes) == 0
    assert not np.array_equal(port.step(session, actions(1)[0]).observation, following.observation)


def test_autoreset_mode_same_step_returns_the_final_observation_separately(port: SurrogatePort, opened: Opened):
    last = run_to_the_limit(port, opened(time_limit=4, autoreset_mode="same_step"))[-1]
    reference = run_to_the_limit(port, opened(time_limit=4, autoreset_mode="next_step"))[-1]
    np.testing.assert_array_equal(last.final_lanes, np.arange(N))
    np.testing.assert_array_equal(last.final_observation, reference.observation)
    np.testing.assert_array_equal(last.observation, next_start(port, opened()))
    np.testing.assert_array_equal(last.reward, reference.reward)


def test_autoreset_mode_disabled_requires_a_reset_of_finished_environments(
    port: SurrogatePort, opened: Opened, harness
):
    session = opened(time_limit=4, autoreset_mode="disabled")
    last = run_to_the_limit(port, session)[-1]
    with pytest.raises(harness.errors.NotReset):
        port.step(session, actions(1)[0])
    mask = np.array([True, False, False])
    start = port.reset(session, mask=mask)
    np.testing.assert_array_equal(start.observation[mask], next_start(port, opened())[mask])
    np.testing.assert_array_equal(start.observation[~mask], last.observation[~mask])
    with pytest.raises(harness.errors.NotReset):
        port.step(session, actions(1)[0])
    assert not port.step(session, actions(1)[0], mask=mask).truncated.any()


# Rollouts


@pytest.mark.parametrize("mode", ["next_step", "same_step"])
def test_a_rollout_of_given_actions_equals_single_steps(port: SurrogatePort, opened: Opened, mode: str):
    options = {"time_limit": 3, "autoreset_mode": mode}
    stepped, rolled = opened(**options), opened(**options)
    assert_same(port.reset(stepped), port.reset(rolled))
    plan = actions(8)
    for ours, action in zip(port.rollout(rolled, plan), plan, strict=True):
        assert_same(ours, port.step(stepped, action))
    assert_same(port.step(rolled, plan[0]), port.step(stepped, plan[0]))


# Errors leave the state as it was


def step_of(action: Any, **options: Any) -> Callable[[SurrogatePort, str], object]:
    return lambda port, session: port.step(session, action, **options)


def reset_of(**options: Any) -> Callable[[SurrogatePort, str], object]:
    return lambda port, session: port.reset(session, **options)


GOOD = np.zeros((N, 1))
BAD: dict[str, tuple[Callable[[SurrogatePort, str], object], str]] = {
    "NaN": (step_of(np.full((N, 1), np.nan)), "finite"),
    "infinity": (step_of(np.full((N, 1), np.inf)), "finite"),
    "out of bounds": (step_of(np.full((N, 1), 1e9)), r"\[-2, 2\]"),
    "too few lanes": (step_of(np.zeros((N - 1, 1))), r"\(3, 1\)"),
    "too many entries": (step_of(np.zeros((N, 2))), r"\(3, 1\)"),
    "short mask": (step_of(GOOD, mask=np.ones(N - 1, dtype=bool)), "mask"),
    "short mask of a reset": (reset_of(mask=np.ones(N + 1, dtype=bool)), "mask"),
    "short list of seeds": (reset_of(seed=[1, 2]), "seed"),
    "negative seed": (reset_of(seed=-1), "seed"),
    "bad last step of a rollout": (
        lambda port, session: port.rollout(session, np.stack([GOOD, GOOD + 3])),
        r"\[-2, 2\]",
    ),
}


@pytest.mark.parametrize("what", list(BAD))
def test_invalid_session_input_is_refused_and_changes_nothing(port: SurrogatePort, opened: Opened, harness, what: str):
    touched, undisturbed = opened(), opened()
    port.reset(touched)
    port.reset(undisturbed)
    request, message = BAD[what]
    with pytest.raises(harness.errors.InvalidInput, match=message):
        request(port, touched)
    for action in actions(2):
        assert_same(port.step(touched, action), port.step(undisturbed, action))


def test_a_session_step_before_the_first_reset_is_refused(port: SurrogatePort, opened: Opened, harness):
    session = opened()
    with pytest.raises(harness.errors.NotReset):
        port.step(session, GOOD)
    assert_same(port.reset(session), port.reset(opened()))


def test_opening_a_session_with_an_unknown_model_version_is_refused(port: SurrogatePort, harness):
    with pytest.raises(harness.errors.UnknownModel):
        port.open(OpenSession(model=999))


def test_a_closed_session_is_unknown_and_closing_it_again_is_harmless(port: SurrogatePort, harness):
    session = port.open(OpenSession()).id
    port.close(session)
    port.close(session)
    with pytest.raises(harness.errors.UnknownSession):
        port.reset(session)


# Occupancy


def test_visited_states_are_collected_on_request(port: SurrogatePort, opened: Opened, harness):
    session = opened(occupancy=True)
    with pytest.raises(harness.errors.NotReset):
        port.submit_occupancy(session, "too early")
    port.reset(session)
    port.rollout(session, actions(4))
    assert port.submit_occupancy(session, "after four steps").states == 5 * N
    with pytest.raises(harness.errors.InvalidInput):
        port.submit_occupancy(opened(), "nothing collected")
