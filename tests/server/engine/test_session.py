"""One session: lanes of several model versions step as if apart, and what is saved comes back whole."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.acting import assert_same_rollout, random_policy
from surrogym_server.engine.requests import roll_policy
from surrogym_server.engine.session import (
    Fingerprint,
    Session,
    answered,
    digest_of,
    replay,
    reset_session,
    session_from_bytes,
    session_to_bytes,
    step_session,
)
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import Damaged, InvalidInput, SeqConflict
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_shared.acting import NoiseKey, PolicyRun
from surrogym_shared.port import StepResult

Open = Callable[..., Session]
Fitted = Callable[[int], GaussianProcessModel]
VERSIONS = {1: 4, 2: 9}  # samples of each version's model
ARRAYS = ("observation", "reward", "terminated", "truncated", "final_lanes", "final_observation", "deviation")
ARRAYS += ("untrusted",)


def stepped(fitted: Fitted, session: Session, action: float = 0.5, latest: int = 2) -> tuple[Session, StepResult]:
    u = np.full((session.settings.num_envs, 1), action)
    return step_session(session, u, None, True, lambda version: fitted(VERSIONS[version]), latest)


def test_environments_of_two_model_versions_in_one_session_step_as_if_separate(opened: Open, fitted: Fitted):
    session, _ = reset_session(opened(), None, None, 1)
    one = [stepped(fitted, replace(session, versions=np.full(4, version)))[1] for version in (1, 2)]
    mixed, result = stepped(fitted, replace(session, versions=np.array([2, 1, 1, 2])))
    assert not np.allclose(one[0].reward, one[1].reward), "the versions differ"
    for lane, version in enumerate([2, 1, 1, 2]):
        for name in ("observation", "reward", "deviation"):
            ours, theirs = getattr(result, name)[lane], getattr(one[version - 1], name)[lane]
            np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(mixed.versions, [2, 1, 1, 2])


def test_environments_of_two_model_versions_can_end_in_the_same_step(opened: Open, fitted: Fitted):
    session, _ = reset_session(opened(time_limit=1), None, None, 1)
    after, result = stepped(fitted, replace(session, versions=np.array([2, 1, 1, 2])))
    np.testing.assert_array_equal(result.final_lanes, [0, 1, 2, 3])
    assert result.truncated.all()
    alone = stepped(fitted, replace(session, versions=np.full(4, 2)))[1]
    np.testing.assert_allclose(result.final_observation[[0, 3]], alone.final_observation[[0, 3]], rtol=1e-6)
    np.testing.assert_array_equal(after.versions, [2, 2, 2, 2])


def test_a_masked_reset_moves_only_the_masked_environments_to_the_latest_model(opened: Open):
    session, _ = reset_session(opened(), None, None, 1)
    session, result = reset_session(session, None, np.array([True, False, False, True]), 2)
    np.testing.assert_array_equal(result.model_version, [2, 1, 1, 2])


def test_a_step_mask_of_wrong_length_is_refused(opened: Open, fitted: Fitted):
    session, _ = reset_session(opened(), None, None, 1)
    session = replace(session, versions=np.array([1, 2, 1, 2]))
    with pytest.raises(InvalidInput, match="expected 4 entries, one for each lane, got 3"):
        step_session(session, np.zeros((4, 1)), np.ones(3, dtype=bool), False, fitted, 2)


def test_only_stepped_environments_add_visited_states(opened: Open, fitted: Fitted):
    session, _ = reset_session(opened(occupancy=True), None, None, 1)
    mask = np.array([True, False, False, False])
    session, _ = step_session(session, np.zeros((4, 1)), mask, False, lambda _: fitted(6), 1)
    assert session.visited is not None
    assert session.visited.visits == 5
    np.testing.assert_array_equal(session.visited.states[4], session.lanes.q[0])


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("variant", ["deterministic", "probabilistic", "pathwise"])
def test_a_restored_session_continues_bit_for_bit(
    opened: Open, fitted: Fitted, definition: EnvironmentDefinition, variant: str, compiled: bool
):
    chosen = {"variant": variant, "particles": 8, "trust": 2.0, "process_noise": True, "compiled": compiled}
    chosen |= {"autoreset_mode": "same_step", "time_limit": 3, "start_visited": 0.5}
    chosen["visited"] = torch.linspace(-1, 1, 5 * len(definition.coordinates), dtype=torch.float64).reshape(5, -1)
    chosen["sensor_noise"] = ((definition.coordinate_names[0], 0.1),)
    chosen["set_points"] = ((definition.coordinate_names[0], 0.5),)
    session, _ = reset_session(opened(occupancy=True, **chosen), 11, None, 1)
    results = []
    for _ in range(2):
        session, result = stepped(fitted, session)
        results.append(result)
    session, answer = answered(session, Fingerprint("digest"), tuple(results))
    back = session_from_bytes(definition, session_to_bytes(session))
    assert (back.id, back.seed, back.settings, back.seq, back.model) == ("s", 3, session.settings, 1, "latest")
    for ours, theirs in zip(replay(back, 1, Fingerprint("digest")).outcome, answer.outcome, strict=True):
        for name in ARRAYS:
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), strict=True)
    for _ in range(4):
        (session, ours), (back, theirs) = stepped(fitted, session), stepped(fitted, back)
        for name in ARRAYS:
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), strict=True)
    np.testing.assert_array_equal(back.visited.states, session.visited.states)


def test_a_saved_session_with_a_flipped_bit_is_refused_or_restored_unchanged(
    opened: Open, definition: EnvironmentDefinition
):
    session, _ = reset_session(opened(), 11, None, 1)
    saved, refused = session_to_bytes(session), 0
    for place in np.random.default_rng(0).integers(len(saved), size=300):
        flipped = bytearray(saved)
        flipped[place] ^= 1 << int(place % 8)
        try:
            back = session_from_bytes(definition, bytes(flipped))
        except Damaged:
            refused += 1
        else:
            assert session_to_bytes(back) == saved, "it was a byte that says nothing"
    assert refused > 150


def test_pathwise_environments_of_two_model_versions_step_as_if_separate(opened: Open, fitted: Fitted):
    session, _ = reset_session(opened(variant="pathwise"), 11, None, 1)
    mixed = replace(session, versions=np.array([2, 1, 1, 2]))
    for _ in range(2):
        mixed, result = stepped(fitted, mixed)
    one = [replace(session, versions=np.full(4, version)) for version in (1, 2)]
    for lane, version in enumerate([2, 1, 1, 2]):
        alone = one[version - 1]
        for _ in range(2):
            alone, expected = stepped(fitted, alone)
        np.testing.assert_allclose(result.observation[lane], expected.observation[lane], rtol=1e-6)


def test_a_saved_session_replays_its_last_reset_reply(opened: Open, definition: EnvironmentDefinition):
    session, result = reset_session(opened(), 5, None, 1)
    session, _ = answered(session, Fingerprint("digest"), result)
    back = session_from_bytes(definition, session_to_bytes(session))
    np.testing.assert_array_equal(
        replay(back, 1, Fingerprint("digest")).outcome.observation, result.observation, strict=True
    )


@pytest.mark.parametrize("noise", [None, NoiseKey(3)])
def test_a_saved_session_replays_its_last_policy_rollout_reply(
    opened: Open, fitted: Fitted, definition: EnvironmentDefinition, noise
):
    session, _ = reset_session(opened(trust=100.0, autoreset_mode="same_step", time_limit=2), 5, None, 1)

    def step(session: Session, u: np.ndarray) -> tuple[Session, StepResult]:
        return step_session(session, u, None, False, lambda version: fitted(VERSIONS[version]), 1)

    session, rollout = roll_policy(session, PolicyRun(random_policy((3, 4, 1)), 5, noise), step)
    session, _ = answered(session, Fingerprint("digest"), rollout)
    back = session_from_bytes(definition, session_to_bytes(session))
    assert_same_rollout(replay(back, 1, Fingerprint("digest")).outcome, rollout)


def test_only_the_next_sequence_number_or_an_exact_repeat_is_accepted(opened: Open):
    session, result = reset_session(opened(), None, None, 1)
    a, b = Fingerprint("step", "a"), Fingerprint("step", "b")
    assert replay(session, 1, a) is None
    session, answer = answered(session, a, result)
    assert replay(session, None, a) is None
    assert replay(session, 2, b) is None
    assert replay(session, 1, Fingerprint("step", "a")) is answer
    assert replay(session, 1, Fingerprint(digest=a.digest)) is answer
    for seq, request in ((1, b), (3, a), (9, a)):
        with pytest.raises(SeqConflict) as refusal:
            replay(session, seq, request)
        assert refusal.value.expected == 2


def test_different_requests_have_different_digests():
    action = np.array([[0.5], [1.0]])
    requests = [
        ("step", action, None, False),
        ("step", action, None, True),
        ("step", action, np.array([True, True]), False),
        ("step", action[::-1], None, False),
        ("step", action.T, None, False),
        ("rollout", action, None, False),
    ]
    assert len({digest_of(*request) for request in requests}) == len(requests)
    assert digest_of("step", action.copy(order="F"), None, False) == digest_of(*requests[0])
