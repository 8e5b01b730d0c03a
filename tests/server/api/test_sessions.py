"""Sessions over HTTP: a step happens once, seeds mean something, lanes keep their model through an episode."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import numpy as np
import pytest

from support import pendulum
from surrogym_shared import wire

Open = Callable[..., dict[str, Any]]
ACTIONS = [[0.5], [-1.5]]


def send(client: httpx.Client, session: str, what: str, **body: Any) -> httpx.Response:
    return client.post(f"/v1/sessions/{session}/{what}", json=body)


def test_reset_step_and_rollout_replies_match_their_schemas(client: httpx.Client, session: str):
    wire.ResetReply.model_validate_json(send(client, session, "reset").content)
    step = wire.StepReply.model_validate_json(send(client, session, "step", action=ACTIONS, deviations=True).content)
    assert (step.seq, len(step.observation), len(step.observation[0])) == (2, 2, 3)
    assert step.deviation is not None
    assert [len(row) for row in step.deviation] == [3, 3]
    rollout = wire.RolloutReply.model_validate_json(send(client, session, "rollout", actions=[ACTIONS] * 3).content)
    assert (rollout.seq, len(rollout.steps)) == (3, 3)


POLICY = {"mean": [0, 0, 0], "deviation": [1, 1, 8], "layers": [{"weights": [[1], [0.5], [2]], "bias": [0.1]}]}


def test_a_rollout_with_a_handwritten_policy_returns_its_actions_and_probabilities(client: httpx.Client, session: str):
    send(client, session, "reset")
    noisy = {"policy": {**POLICY, "log_deviations": [-1]}, "noise": {"seed": 4}}
    for body, spoken in (({"policy": POLICY}, False), (noisy, True)):
        reply = send(client, session, "rollout", **body, steps=3).raise_for_status()
        rollout = wire.RolloutReply.model_validate_json(reply.content)
        assert (len(rollout.steps), len(rollout.action), len(rollout.action[0])) == (3, 3, 2)
        assert (rollout.log_probability is not None) == spoken


def test_closing_a_session_stops_its_running_rollout(client: httpx.Client, open_session: Open):
    """Long before its steps could have been taken."""
    steps, share = 50_000, 100
    session = open_session(num_envs=2)["id"]
    send(client, session, "reset")
    begun = time.perf_counter()
    send(client, session, "rollout", policy=POLICY, steps=steps // share).raise_for_status()
    whole = share * (time.perf_counter() - begun)
    with ThreadPoolExecutor(1) as threads:
        begun = time.perf_counter()
        rollout = threads.submit(send, client, session, "rollout", policy=POLICY, steps=steps)
        while "surrogym_session_requests 1.0" not in client.get("/metrics").text:
            assert not rollout.done()
        client.delete(f"/v1/sessions/{session}").raise_for_status()
        assert rollout.result().json()["code"] == "unknown_session"
    assert time.perf_counter() - begun < whole / 2


def test_steps_are_answered_while_another_session_runs_a_long_rollout(client: httpx.Client, open_session: Open):
    planner, trainer = open_session(num_envs=2)["id"], open_session(num_envs=2)["id"]
    for session in (planner, trainer):
        send(client, session, "reset")
    with ThreadPoolExecutor(1) as threads:
        rollout = threads.submit(send, client, planner, "rollout", policy=POLICY, steps=20_000)
        while "surrogym_session_requests 1.0" not in client.get("/metrics").text:
            assert not rollout.done()
        for _ in range(5):
            send(client, trainer, "step", action=ACTIONS).raise_for_status()
        assert not rollout.done()
        client.delete(f"/v1/sessions/{planner}")


def test_a_one_dimensional_action_may_be_sent_without_its_inner_list(client: httpx.Client, open_session: Open):
    sessions = [open_session(num_envs=2)["id"] for _ in range(2)]
    replies = []
    for session, action in zip(sessions, (ACTIONS, [row[0] for row in ACTIONS]), strict=True):
        send(client, session, "reset")
        replies.append(send(client, session, "step", action=action).content)
    assert replies[0] == replies[1]


def test_a_repeated_request_gets_the_same_reply_bit_for_bit(client: httpx.Client, session: str):
    bodies = [("reset", {"seq": 1, "seed": 5}), ("step", {"seq": 2, "action": ACTIONS})]
    bodies.append(("rollout", {"seq": 3, "actions": [ACTIONS] * 2}))
    bodies.append(("rollout", {"seq": 4, "policy": POLICY, "steps": 2}))
    for what, body in bodies:
        first, again = (send(client, session, what, **body) for _ in range(2))
        assert (first.status_code, again.content) == (200, first.content)


def test_a_request_repeated_during_its_computation_steps_once(client: httpx.Client, session: str):
    send(client, session, "reset", seq=1)
    body = {"seq": 2, "actions": [ACTIONS] * 200}
    with ThreadPoolExecutor(4) as threads:
        replies = list(threads.map(lambda _: send(client, session, "rollout", **body), range(4)))
    assert {reply.status_code for reply in replies} == {200}
    assert len({reply.content for reply in replies}) == 1
    assert client.get(f"/v1/sessions/{session}").json()["seq"] == 2


@pytest.mark.parametrize("seq", [1, 4, 99])
def test_an_unexpected_sequence_number_is_refused_with_the_expected_one(client: httpx.Client, session: str, seq: int):
    send(client, session, "reset", seq=1)
    send(client, session, "step", seq=2, action=ACTIONS)
    refusal = send(client, session, "step", seq=seq, action=ACTIONS)
    assert (refusal.status_code, refusal.json()["code"]) == (409, "seq_conflict")
    assert refusal.json()["expected_seq"] == 3


def test_a_repeated_sequence_number_with_another_body_is_refused(client: httpx.Client, session: str):
    send(client, session, "reset", seq=1)
    send(client, session, "step", seq=2, action=ACTIONS)
    for other in ({"action": [[0.5], [1.5]]}, {"action": ACTIONS, "deviations": True}):
        assert send(client, session, "step", seq=2, **other).json()["expected_seq"] == 3
    assert send(client, session, "reset", seq=2).json()["expected_seq"] == 3


def test_a_request_without_sequence_number_takes_the_next_one(client: httpx.Client, session: str):
    assert send(client, session, "reset").json()["seq"] == 1
    assert send(client, session, "step", action=ACTIONS).json()["seq"] == 2
    assert send(client, session, "step", seq=3, action=ACTIONS).json()["seq"] == 3


def test_opening_a_session_twice_with_one_idempotency_key_opens_it_once(
    client: httpx.Client, open_session: Open, taught: str, name: str
):
    first, again = (open_session(num_envs=2, idempotency_key=name) for _ in range(2))
    assert first["id"] == again["id"]
    body = {"seed": 0, "num_envs": 3, "idempotency_key": name}
    refusal = client.post(f"/v1/surrogates/{taught}/sessions", json=body)
    assert refusal.json()["code"] == "idempotency_conflict"


def test_session_seed_zero_is_reproducible_and_seed_none_is_random(client: httpx.Client, open_session: Open):
    starts = {}
    for key, seed in (("a", 0), ("b", 0), ("c", 1), ("d", None)):
        session = open_session(num_envs=2, seed=seed)
        starts[key] = send(client, session["id"], "reset").json()["observation"]
        assert seed in (None, session["seed"])
    assert starts["a"] == starts["b"]
    assert starts["a"] != starts["c"]
    assert starts["d"] != starts["a"]


def test_a_masked_step_moves_only_the_masked_environments(client: httpx.Client, session: str):
    start = send(client, session, "reset").json()["observation"]
    step = send(client, session, "step", action=ACTIONS, mask=[False, True]).json()
    assert step["observation"][0] == start[0]
    assert step["observation"][1] != start[1]
    assert step["reward"][0] == 0.0


def test_an_episode_is_truncated_at_the_time_limit_and_the_next_step_resets(client: httpx.Client, open_session: Open):
    session = open_session(num_envs=1, time_limit=2)["id"]
    send(client, session, "reset")
    steps = send(client, session, "rollout", actions=[[[0.0]]] * 4).json()["steps"]
    assert [step["truncated"] for step in steps] == [[False], [True], [False], [False]]
    assert steps[2]["reward"] == [0.0], "this step only began the next episode"


def test_same_step_autoreset_returns_the_final_observation(client: httpx.Client, open_session: Open):
    session = open_session(num_envs=2, time_limit=1, autoreset_mode="same_step")["id"]
    send(client, session, "reset")
    step = send(client, session, "step", action=ACTIONS).json()
    assert step["final_lanes"] == [0, 1]
    assert step["final_observation"] != step["observation"]


def test_visited_states_are_kept_only_if_the_session_asked_for_it(
    client: httpx.Client, session: str, open_session: Open
):
    assert send(client, session, "occupancy", checkpoint="c").json()["code"] == "invalid_request"
    asked = open_session(occupancy=True)["id"]
    assert send(client, asked, "occupancy", checkpoint="c").json()["code"] == "not_reset"


def test_the_coordinates_of_a_session_match_its_observations(client: httpx.Client, session: str):
    observation = send(client, session, "reset", seed=3).json()["observation"]
    coordinates = client.get(f"/v1/sessions/{session}/coordinates").json()["coordinates"]
    angles, speeds = np.array(coordinates).T
    np.testing.assert_allclose(np.stack([np.cos(angles), np.sin(angles), speeds], 1), observation, rtol=1e-6)


def test_virtual_rewards_stay_near_the_range_of_the_sampled_rewards(
    client: httpx.Client, name: str, open_session: Open
):
    pendulum.teach(client, name, budget=5)
    samples = client.get(f"/v1/surrogates/{name}/samples").json()["samples"]
    rewards = [sample["reward"] for sample in samples]
    room = max(max(rewards) - min(rewards), abs(min(rewards)), abs(max(rewards)))
    opened = client.post(f"/v1/surrogates/{name}/sessions", json={"num_envs": 64, "seed": 0, "start_box": 1.0}).json()
    send(client, opened["id"], "reset")
    steps = send(client, opened["id"], "rollout", actions=[[[2.0]] * 64] * 20).json()["steps"]
    imagined = np.array([step["reward"] for step in steps])
    assert imagined.min() >= min(rewards) - room
    assert imagined.max() <= max(rewards) + room


def test_with_start_visited_1_virtual_episodes_start_at_sampled_states(client: httpx.Client, name: str):
    pendulum.teach(client, name, budget=5)
    samples = client.get(f"/v1/surrogates/{name}/samples").json()["samples"]
    asked = {"num_envs": 64, "seed": 0, "start_visited": 1.0}
    session = client.post(f"/v1/surrogates/{name}/sessions", json=asked).json()["id"]
    send(client, session, "reset")
    starts = client.get(f"/v1/sessions/{session}/coordinates").json()["coordinates"]
    assert {tuple(start) for start in starts} == {tuple(sample["coordinates"]) for sample in samples}


def test_start_box_and_start_visited_that_sum_above_one_are_refused(client: httpx.Client, name: str):
    pendulum.teach(client, name, budget=5)
    asked = {"start_box": 0.5, "start_visited": 0.6}
    refused = client.post(f"/v1/surrogates/{name}/sessions", json=asked)
    assert (refused.status_code, "got 1.1" in refused.text) == (422, True)


@pytest.mark.parametrize("functions", [0, 2])
def test_the_option_functions_is_refused_for_variants_other_than_pathwise(
    client: httpx.Client, taught: str, functions: int
):
    options = {"num_envs": 2, "functions": functions, "variant": "deterministic" if functions else "pathwise"}
    refused = client.post(f"/v1/surrogates/{taught}/sessions", json=options)
    assert refused.status_code == 422
    assert "functions" in refused.json()["detail"]


def test_closing_a_session_twice_is_harmless(client: httpx.Client, session: str):
    assert [client.delete(f"/v1/sessions/{session}").status_code for _ in range(2)] == [204, 204]
    assert send(client, session, "reset").json()["code"] == "unknown_session"


def test_an_environment_keeps_its_model_version_until_its_episode_ends(client: httpx.Client, name: str):
    pendulum.teach(client, name, budget=5)
    options = {"num_envs": 2, "seed": 0, "time_limit": 3, "autoreset_mode": "same_step"}
    opened = {
        model: client.post(f"/v1/surrogates/{name}/sessions", json={**options, "model": model}).json()["id"]
        for model in ("latest", 1)
    }
    for id in opened.values():
        send(client, id, "reset")
    send(client, opened["latest"], "step", action=ACTIONS, mask=[True, False])
    export = client.get(f"/v1/surrogates/{name}/models/1", params={"format": "safetensors"}).content
    file = {"content-type": "application/octet-stream"}
    client.post(f"/v1/surrogates/{name}/models", content=export, headers=file).raise_for_status()
    versions = [send(client, opened["latest"], "step", action=ACTIONS).json()["model_version"] for _ in range(3)]
    assert versions == [[1, 1], [2, 1], [2, 2]]
    fixed = [send(client, opened[1], "step", action=ACTIONS).json()["model_version"] for _ in range(4)]
    assert fixed == [[1, 1]] * 4
    client.delete(f"/v1/surrogates/{name}")


def test_the_session_list_counts_each_step_once_and_each_ended_episode(client: httpx.Client, open_session: Open):
    session = open_session(num_envs=2, time_limit=3, autoreset_mode="same_step", penalty=1.0)["id"]
    send(client, session, "reset", seq=1)
    body = {"seq": 2, "actions": [ACTIONS] * 4}
    steps, _ = (send(client, session, "rollout", **body).json()["steps"] for _ in range(2))
    listed = client.get(f"/v1/surrogates/{pendulum_name(client, session)}/sessions").raise_for_status()
    (found,) = [s for s in wire.SessionList.model_validate_json(listed.content).sessions if s.id == session]
    assert (found.steps, found.episodes, found.num_envs) == (8, 2, 2)
    assert found.steps_per_second > 0
    for lane in range(2):
        assert found.returns[lane] == pytest.approx(sum(step["reward"][lane] for step in steps[:3]))
        mean = sum(step["reward_mean"][lane] for step in steps[:3])
        assert found.penalties[lane] == pytest.approx(mean - found.returns[lane])
        assert found.penalties[lane] > 0


def pendulum_name(client: httpx.Client, session: str) -> str:
    return str(client.get(f"/v1/sessions/{session}").json()["surrogate"])
