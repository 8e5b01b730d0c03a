"""Checks of a server. Without a model: leases of queries, late samples, and repeated requests. With a model: numbered
requests, seeds, autoreset, spaces, ends of episodes, errors, transports."""

from __future__ import annotations

import time
from typing import Any, get_args

import numpy as np

from surrogym_client.transport.http_surrogate import HttpSurrogate, Transport
from surrogym_sampler.diagnosis.conformance.target import END, TIME_LIMIT, Target, answer
from surrogym_sampler.diagnosis.outcomes import expect
from surrogym_shared.wire import OpenSession

SHORT_LEASE = 0.3  # duration, in seconds, of a lease that a check lets expire


def a_lease_is_renewed_by_its_token_alone(target: Target) -> None:
    query = target.claim()
    path = f"surrogates/{target.surrogate}/queries/{query.id}"
    expect("renewal", True, target.post(f"{path}:renew", {"lease_token": query.lease_token}).is_success)
    foreign = target.post(f"{path}:renew", {"lease_token": "of-somebody-else"})
    target.refused("a renewal under a foreign token", foreign, 403, "foreign_lease")
    target.api.fail(target.surrogate, query.id, query.lease_token, "given back by the conformance suite")


def a_failed_query_is_given_out_again(target: Target) -> None:
    first = target.claim()
    target.api.fail(target.surrogate, first.id, first.lease_token, "given back by the conformance suite")
    statuses = {query.id: query.status for query in target.api.queries(target.surrogate)}
    expect("status of a query that failed once", "pending", statuses[first.id])


def a_late_answer_is_kept_once(target: Target) -> None:
    query = target.claim(SHORT_LEASE)
    time.sleep(2 * SHORT_LEASE)
    path = f"surrogates/{target.surrogate}"
    late = target.post(f"{path}/queries/{query.id}:renew", {"lease_token": query.lease_token})
    target.refused("a renewal of an expired lease", late, 409, "lease_expired")
    body = {"sampler": "conformance", "samples": [answer(query).model_dump(mode="json", exclude_none=True)]}
    first, again = (target.post(f"{path}/add_sample", body).json() for _ in range(2))
    expect("duplicates in the late answer", 0, first["duplicates"])
    expect("duplicates in its repeat", 1, again["duplicates"])
    expect("sample of the repeat", first["sample_ids"], again["sample_ids"])


def an_idempotency_key_stands_for_one_body(target: Target) -> None:
    path = f"surrogates/{target.surrogate}/ledger"
    body = {"steps": 3, "idempotency_key": "conformance"}
    first, again = (target.post(path, body) for _ in range(2))
    expect("status of a report", True, first.is_success)
    expect("ledger after a repeat", first.json(), again.json())
    target.refused("the key with another body", target.post(path, body | {"steps": 4}), 409, "idempotency_conflict")


def no_session_without_a_model(target: Target) -> None:
    reply = target.post(f"surrogates/{target.surrogate}/sessions", {})
    target.refused("a session without a model", reply, 409, "no_model")


WITHOUT_MODEL = (
    no_session_without_a_model,
    a_lease_is_renewed_by_its_token_alone,
    a_failed_query_is_given_out_again,
    a_late_answer_is_kept_once,
    an_idempotency_key_stands_for_one_body,
)


BACK = [[-1.0], [-1.0]]
ON_AND_BACK = [[1.0], [-1.0]]  # actions that end the episode of the first lane, not of the second
ROLLED = 5  # number of steps in a tested rollout: more than an episode has, so that the rollout contains a reset


def the_same_seq_and_body_get_the_same_reply(target: Target) -> None:
    session = target.open()
    target.act(session, "reset", seq=1)
    path, body = f"sessions/{session}/step", {"seq": 2, "action": BACK}
    first, again = (target.post(path, body) for _ in range(2))
    expect("bytes of the repeat", first.content, again.content)
    expect("seq of the step after a repeat", 3, target.act(session, "step", seq=3, action=BACK)["seq"])


def any_other_seq_or_body_is_refused(target: Target) -> None:
    session = target.open()
    target.act(session, "reset", seq=1)
    target.act(session, "step", seq=2, action=BACK)
    for what, seq, action in (("another body", 2, ON_AND_BACK), ("a seq of the past", 1, BACK), ("a gap", 9, BACK)):
        reply = target.post(f"sessions/{session}/step", {"seq": seq, "action": action})
        expect(f"expected_seq after {what}", 3, target.refused(what, reply, 409, "seq_conflict").get("expected_seq"))


def a_seed_fixes_the_starts(target: Target) -> None:
    for seed in (0, 5, [3, 4]):
        first, again = (target.act(target.open(seed=1), "reset", seed=seed)["observation"] for _ in range(2))
        expect(f"starts under seed {seed} again", first, again)
    same = target.act(target.open(), "reset", seed=[6, 6])["observation"]
    expect("starts of two lanes with one seed", same[0], same[1])
    one = target.act(target.open(), "reset", seed=6)["observation"]
    expect("two lanes of one int seed start apart", True, one[0] != one[1])


def a_second_unseeded_reset_goes_on_with_the_seed(target: Target) -> None:
    first, again = ([target.act(s, "reset")["observation"] for _ in range(2)] for s in (target.open(), target.open()))
    expect("both resets of another session with the same seed", first, again)
    expect("the second episode starts elsewhere", True, first[0] != first[1])


def next_step_resets_in_the_step_after_the_end(target: Target) -> None:
    session = target.open(autoreset_mode="next_step")
    target.act(session, "reset")
    end = target.act(session, "step", action=ON_AND_BACK)
    expect("terminated", [True, False], end["terminated"])
    expect("the last observation is beyond the end", True, end["observation"][0][0] >= END)
    after = target.act(session, "step", action=BACK)
    expect("reward of the resetting step", 0.0, after["reward"][0])
    expect("terminated in the resetting step", False, after["terminated"][0])
    expect("the new episode is before the end", True, after["observation"][0][0] < END)


def same_step_resets_and_tells_the_last_observation(target: Target) -> None:
    session = target.open(autoreset_mode="same_step")
    target.act(session, "reset")
    end = target.act(session, "step", action=ON_AND_BACK)
    expect("terminated", [True, False], end["terminated"])
    expect("lanes with a final observation", [0], end["final_lanes"])
    expect("the final observation is beyond the end", True, end["final_observation"][0][0] >= END)
    expect("the observation is of the new episode", True, end["observation"][0][0] < END)


def disabled_waits_for_a_reset_by_mask(target: Target) -> None:
    session = target.open(autoreset_mode="disabled")
    target.act(session, "reset")
    end = target.act(session, "step", action=ON_AND_BACK)
    reply = target.post(f"sessions/{session}/step", {"action": BACK})
    target.refused("a step of a finished lane", reply, 409, "not_reset")
    start = target.act(session, "reset", mask=[True, False])["observation"]
    expect("the lane outside the mask", end["observation"][1], start[1])
    expect("the lane of the mask starts anew", True, start[0][0] < END)
    target.act(session, "step", action=BACK)


def the_time_limit_truncates_and_does_not_terminate(target: Target) -> None:
    session = target.open()
    target.act(session, "reset")
    steps = [target.act(session, "step", action=BACK) for _ in range(TIME_LIMIT)]
    expect("truncated", [[False] * 2] * (TIME_LIMIT - 1) + [[True] * 2], [step["truncated"] for step in steps])
    expect("terminated", [[False] * 2] * TIME_LIMIT, [step["terminated"] for step in steps])


def observations_lie_in_their_space(target: Target) -> None:
    reply = target.post(f"surrogates/{target.surrogate}/sessions", {"num_envs": 2, "seed": 7}).json()
    space = reply["observation_space"]
    low = [-np.inf if bound is None else bound for bound in space["low"]]
    high = [np.inf if bound is None else bound for bound in space["high"]]
    seen = np.array(target.act(reply["id"], "reset")["observation"])
    expect("shape of the observation", (2, len(low)), seen.shape)
    expect("within the observation space", True, bool(((low <= seen) & (seen <= high)).all()))
    expect("bounds of the action space", ([-1.0], [1.0]), (reply["action_space"]["low"], reply["action_space"]["high"]))


def bad_input_is_refused_and_changes_nothing(target: Target) -> None:
    session = target.open()
    target.act(session, "reset", seq=1)
    path = f"sessions/{session}/step"
    bodies: dict[str, Any] = {
        "a wrong shape": '{"seq": 2, "action": [[0, 0], [0, 0]]}',
        "too few lanes": '{"seq": 2, "action": [[0]]}',
        "NaN": '{"seq": 2, "action": [[NaN], [0]]}',
        "an action out of bounds": '{"seq": 2, "action": [[9], [0]]}',
        "an unknown field": '{"seq": 2, "action": [[0], [0]], "unknown": 1}',
        "no JSON": "{",
    }
    for what, body in bodies.items():
        target.refused(what, target.post_text(path, body), 422, "invalid_request")
    expect("seq of the step after refusals", 2, target.act(session, "step", seq=2, action=BACK)["seq"])


def what_is_not_there_is_named(target: Target) -> None:
    target.refused("an unknown session", target.post("sessions/none/reset", {}), 404, "unknown_session")
    elsewhere = target.post(f"surrogates/{target.surrogate}-none/sessions", {})
    target.refused("an unknown surrogate", elsewhere, 404, "unknown_surrogate")


def every_transport_gives_the_same_numbers(target: Target) -> None:
    seen = {transport: _trajectory(target, transport) for transport in get_args(Transport)}
    for transport, trajectory in seen.items():
        expect(f"trajectory over {transport}", seen["json"], trajectory)


def _trajectory(target: Target, transport: Transport) -> list[list[list[float]]]:
    with HttpSurrogate(target.api.url, target.surrogate, target.token, transport=transport) as port:
        session = port.open(OpenSession(num_envs=2, seed=3)).id
        rows = [port.reset(session).observation.tolist()]
        for _ in range(ROLLED):
            step = port.step(session, np.array(ON_AND_BACK))
            rows += [step.observation.tolist(), [step.reward.tolist()]]
        port.close(session)
    return rows


WITH_MODEL = (
    the_same_seq_and_body_get_the_same_reply,
    any_other_seq_or_body_is_refused,
    a_seed_fixes_the_starts,
    a_second_unseeded_reset_goes_on_with_the_seed,
    next_step_resets_in_the_step_after_the_end,
    same_step_resets_and_tells_the_last_observation,
    disabled_waits_for_a_reset_by_mask,
    the_time_limit_truncates_and_does_not_terminate,
    observations_lie_in_their_space,
    bad_input_is_refused_and_changes_nothing,
    what_is_not_there_is_named,
    every_transport_gives_the_same_numbers,
)
