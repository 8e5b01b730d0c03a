"""Bad input gets a clear 4xx problem body, and changes nothing."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from support import pendulum
from surrogym_shared.codes import PROBLEM_MEDIA_TYPE, STATUS, Code, Problem
from surrogym_shared.patterns import IN_WORDS

MAX_BODY = 32 * 1024 * 1024
FILE = "application/octet-stream"


def refused(reply: httpx.Response, code: Code, *said: str) -> Problem:
    """The problem body of a refusal, which says all of ``said``."""
    assert reply.headers["content-type"] == PROBLEM_MEDIA_TYPE, reply.text
    problem = Problem.model_validate_json(reply.content)
    assert (problem.code, problem.status, reply.status_code) == (code, STATUS[code], STATUS[code]), reply.text
    for words in said:
        assert words in problem.detail
    return problem


def post(client: httpx.Client, path: str, body: Any) -> httpx.Response:
    """Unlike the client's own JSON, this sends NaN too."""
    return client.post(path, content=json.dumps(body), headers={"content-type": "application/json"})


# Unknown things


@pytest.mark.parametrize(
    ("method", "path", "code"),
    [
        ("GET", "/v1/surrogates/nobody", Code.UNKNOWN_SURROGATE),
        ("DELETE", "/v1/surrogates/nobody", Code.UNKNOWN_SURROGATE),
        ("GET", "/v1/surrogates/nobody/samples", Code.UNKNOWN_SURROGATE),
        ("GET", "/v1/surrogates/nobody/samples?format=csv", Code.UNKNOWN_SURROGATE),
        ("GET", "/v1/surrogates/nobody/queries", Code.UNKNOWN_SURROGATE),
        ("GET", "/v1/surrogates/nobody/models", Code.UNKNOWN_SURROGATE),
        ("GET", "/v1/surrogates/nobody/models/1", Code.UNKNOWN_SURROGATE),
        ("GET", "/v1/surrogates/nobody/events", Code.UNKNOWN_SURROGATE),
        ("GET", "/v1/sessions/nobody", Code.UNKNOWN_SESSION),
        ("GET", "/v1/nothing", Code.NOT_FOUND),
        ("PUT", "/v1/surrogates", Code.METHOD_NOT_ALLOWED),
    ],
)
def test_requests_for_unknown_resources_get_the_matching_error_code(
    client: httpx.Client, method: str, path: str, code: Code
):
    refused(client.request(method, path), code)


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("queries:claim", {"sampler": "s"}),
        ("queries", {"coordinates": [[0, 0]], "action": [[0]]}),
        ("add_sample", {"sampler": "s", "idempotency_key": "k", "samples": [pendulum.real_step([0, 0], [0])]}),
        ("ledger", {"steps": 1, "idempotency_key": "k"}),
        ("improve", {"queries": 1}),
        ("predict", {"coordinates": [[0, 0]], "action": [[0]]}),
        ("query_uncertainty", {"coordinates": [[0, 0]], "action": [[0]]}),
        ("sessions", {}),
    ],
)
def test_every_post_to_an_unknown_surrogate_is_refused(client: httpx.Client, path: str, body: Any):
    refused(post(client, f"/v1/surrogates/nobody/{path}", body), Code.UNKNOWN_SURROGATE, "nobody")


@pytest.mark.parametrize("what", ["reset", "step", "rollout", "occupancy"])
def test_every_post_to_an_unknown_session_is_refused(client: httpx.Client, what: str):
    bodies = {"step": {"action": [[0]]}, "rollout": {"actions": [[[0]]]}, "occupancy": {"checkpoint": "c"}}
    reply = post(client, f"/v1/sessions/nobody/{what}", bodies.get(what, {}))
    refused(reply, Code.UNKNOWN_SESSION, "'nobody'")


# Specifications


UNIT = {"kind": "uniform", "low": 0, "high": 1}
TWO = {"kind": "uniform", "low": 1, "high": 2}
ONE = {"parts": [{"function": "one"}]}


def crossed(field: str, value: Any) -> dict[str, Any]:
    spec = copy.deepcopy(pendulum.spec())
    target = spec
    *path, last = field.split(".")
    for part in path:
        target = target[int(part)] if part.isdigit() else target[part]
    target[last] = value
    return spec


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("coordinates.0.sampling.low", 4.0, "uniform range crosses: expected low < high, got [4.0, 3.1416]"),
        ("coordinates.1.bounds.low", 9.0, "bounds cross"),
        ("action.low", [3.0], "action 0 crosses"),
        ("coordinates.1.sampling.high", 9.0, "leaves its bounds [-8.0, 8.0]"),
        ("coordinates.0.colour", "red", "expected no entry of this name, got 'red'"),
        ("coordinates.0.sampling.low", float("nan"), "finite number, got nan"),
        ("start", {}, "start distribution lacks ['theta', 'theta_dot']"),
        ("time_limit", 0, "greater than or equal to 1, got 0"),
        ("time_limit", True, "whole number, got True"),
        ("action.low", ["-2"], "expected a number, got '-2'"),
        ("coordinates.0.sampling.high", 1e308, "less than or equal to 1000000000000, got 1e+308"),
        ("coordinates.0.sampling", {"kind": "uniform", "low": 0, "high": 5e-324}, "too narrow"),
        ("coordinates.0.sampling", {"kind": "uniform", "low": 1e10, "high": 1e10 + 1}, "too narrow"),
        ("coordinates.1.bounds.stops", "theta_dot", "in its bounds' stops, got itself"),
        ("termination", [[{"term": ONE, "relation": ">", "value": 0}]] * 17, "at most 16 entries"),
    ],
)
def test_a_contradictory_specification_is_refused(client: httpx.Client, name: str, field: str, value: Any, said: str):
    reply = post(client, "/v1/surrogates", {"name": name, "spec": crossed(field, value)})
    problem = refused(reply, Code.INVALID_SPEC, said)
    assert problem.model_extra is not None
    assert problem.model_extra["errors"][0]["field"].startswith("spec")
    refused(client.get(f"/v1/surrogates/{name}"), Code.UNKNOWN_SURROGATE)


def test_a_list_whose_entries_are_invalid_is_not_also_called_empty(client: httpx.Client, name: str):
    reply = post(client, "/v1/surrogates", {"name": name, "spec": crossed("coordinates", [{"nam": "x"}])})
    problem = refused(reply, Code.INVALID_SPEC, "spec.coordinates.0")
    assert problem.model_extra is not None
    assert {error["field"].removeprefix("spec.coordinates.0.") for error in problem.model_extra["errors"]} == {
        *("name", "sampling", "nam")
    }


def test_a_bound_that_stops_another_coordinate_outside_its_range_is_refused(client: httpx.Client, name: str):
    """The model would set a coordinate where the environment never lets it be."""
    spec = pendulum.spec()
    spec["coordinates"].append({"name": "x", "sampling": UNIT, "bounds": {"low": 0, "high": 1, "stops": "gear"}})
    spec["coordinates"].append({"name": "gear", "sampling": TWO, "bounds": {"low": 1, "high": 2}})
    spec["start"] |= {"x": UNIT, "gear": TWO}
    reply = post(client, "/v1/surrogates", {"name": name, "spec": spec})
    refused(reply, Code.INVALID_SPEC, "expected bounds of 'gear' that contain 0, got [1.0, 2.0]")


def test_another_specification_under_an_existing_surrogate_name_is_refused(client: httpx.Client, fresh: str):
    before = client.get(f"/v1/surrogates/{fresh}").json()
    other = pendulum.spec()
    other["time_limit"] = 100
    refused(post(client, "/v1/surrogates", {"name": fresh, "spec": other}), Code.SPEC_CONFLICT, fresh)
    assert client.get(f"/v1/surrogates/{fresh}").json() == before


@pytest.mark.parametrize("bad", ["", "a/b", "-x", "x" * 65, "ä"])
def test_an_invalid_name_is_refused(client: httpx.Client, bad: str):
    refused(post(client, "/v1/surrogates", {"name": bad, "spec": pendulum.spec()}), Code.INVALID_REQUEST, "name")


# Samples and leases


def sample(**changes: Any) -> dict[str, Any]:
    return {**pendulum.real_step([0.1, 0.0], [0.5]), **changes}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"coordinates": [0.1]}, "samples.0.coordinates: expected shape (n, 2)"),
        ({"next_coordinates": [0.1, 0.2, 0.3]}, "samples.0.next_coordinates: expected shape (n, 2)"),
        ({"action": [0.1, 0.2]}, "action: expected shape (1, 1), got (1, 2)"),
        ({"reward": 1e200}, "less than or equal to 1000"),
        ({"next_coordinates": [0.1, -1e308]}, "greater than or equal to -1000"),
        ({"action": [2.5]}, "action: expected entry 0 in [-2, 2], got 2.5"),
        ({"observation": [1.0]}, "samples.0.observation: expected 3 numbers, one for each observation entry, got 1"),
        ({"reward": float("nan")}, "samples.0.reward: expected a finite number, got nan"),
        ({"coordinates": [float("inf"), 0.0]}, "samples.0.coordinates.0: expected a finite number, got inf"),
        ({"reward": "1.0"}, "samples.0.reward: expected a number, got '1.0'"),
        ({"terminated": 1}, "samples.0.terminated: expected true or false, got 1"),
        ({"mood": "good"}, "samples.0.mood: expected no entry of this name, got 'good'"),
        ({"query_id": 1}, "expected both query_id and lease_token, or neither, got one"),
    ],
)
def test_an_invalid_sample_is_refused_and_nothing_is_stored(
    client: httpx.Client, fresh: str, changes: dict[str, Any], said: str
):
    body = {"sampler": "s", "idempotency_key": "k", "samples": [sample(), sample(**changes)][::-1]}
    refused(post(client, f"/v1/surrogates/{fresh}/add_sample", body), Code.INVALID_REQUEST, said)
    assert client.get(f"/v1/surrogates/{fresh}/samples").json()["samples"] == []


def test_a_wrong_lease_token_cannot_answer_renew_or_fail_a_query(client: httpx.Client, fresh: str):
    query = pendulum.claim(client, fresh, max_queries=1)["queries"][0]
    foreign = {"query_id": query["id"], "lease_token": "not-the-token"}
    body = {"sampler": "thief", "samples": [sample(**foreign)]}
    refused(post(client, f"/v1/surrogates/{fresh}/add_sample", body), Code.FOREIGN_LEASE)
    path = f"/v1/surrogates/{fresh}/queries/{query['id']}"
    refused(post(client, f"{path}:renew", {"lease_token": "not-the-token"}), Code.FOREIGN_LEASE)
    refused(post(client, f"{path}:fail", {"lease_token": "not-the-token", "error": "e"}), Code.FOREIGN_LEASE)
    view = client.get(f"/v1/surrogates/{fresh}").json()
    assert (view["queries"]["leased"], view["samples"]) == (1, 0)


def test_a_sample_for_an_unknown_query_is_refused(client: httpx.Client, fresh: str):
    body = {"sampler": "s", "samples": [sample(query_id=10**9, lease_token="t")]}
    refused(post(client, f"/v1/surrogates/{fresh}/add_sample", body), Code.UNKNOWN_QUERY)


def test_a_sample_without_query_and_idempotency_key_is_refused(client: httpx.Client, fresh: str):
    body = {"sampler": "s", "samples": [sample()]}
    refused(post(client, f"/v1/surrogates/{fresh}/add_sample", body), Code.INVALID_REQUEST, "idempotency_key")


def test_reusing_an_idempotency_key_with_another_sample_is_refused(client: httpx.Client, fresh: str):
    path = f"/v1/surrogates/{fresh}/add_sample"
    body = {"sampler": "s", "idempotency_key": "k", "samples": [sample()]}
    first = post(client, path, body).json()
    assert post(client, path, body).json()["sample_ids"] == first["sample_ids"]
    refused(post(client, path, {**body, "samples": [sample(reward=0.0)]}), Code.IDEMPOTENCY_CONFLICT)
    assert client.get(f"/v1/surrogates/{fresh}").json()["ledger"]["manual"] == 1


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ({"coordinates": [[0, 0, 0]], "action": [[0]]}, "coordinates: expected shape (n, 2)"),
        ({"coordinates": [[0, 9]], "action": [[0]]}, "'theta_dot': expected a value in [-8, 8], got 9"),
        ({"coordinates": [[4, 0]], "action": [[0]]}, "'theta': expected a value in [-3.1416, 3.1416], got 4"),
        ({"coordinates": [[0, 0], [0]], "action": [[0], [0]]}, "coordinates: expected rows of equal length"),
        (
            {"coordinates": [[0, 0]], "action": [[0], [0]]},
            "one action for each row of coordinates, got 2 actions and 1 rows of coordinates",
        ),
        ({"coordinates": [], "action": []}, "expected 1 or more entries"),
    ],
)
def test_a_manual_query_outside_the_specification_is_refused_and_not_stored(
    client: httpx.Client, fresh: str, body: Any, said: str
):
    refused(post(client, f"/v1/surrogates/{fresh}/queries", body), Code.INVALID_REQUEST, said)
    assert len(client.get(f"/v1/surrogates/{fresh}/queries").json()["queries"]) == pendulum.INITIAL


# Models


def test_predicting_at_an_invalid_action_or_with_an_unknown_model_is_refused(client: httpx.Client, taught: str):
    for path in ("predict", "query_uncertainty"):
        body = {"coordinates": [[0, 0]], "action": [[5]]}
        refused(post(client, f"/v1/surrogates/{taught}/{path}", body), Code.INVALID_REQUEST, "[-2, 2], got 5")
        good = {"coordinates": [[0, 0]], "action": [[1]]}
        refused(post(client, f"/v1/surrogates/{taught}/{path}", {**good, "model": 99}), Code.UNKNOWN_MODEL)


def test_sessions_and_predictions_before_the_first_fit_are_refused(client: httpx.Client, fresh: str):
    refused(post(client, f"/v1/surrogates/{fresh}/sessions", {}), Code.NO_MODEL)
    points = {"coordinates": [[0, 0]], "action": [[0]]}
    refused(post(client, f"/v1/surrogates/{fresh}/predict", points), Code.NO_MODEL)


def test_a_removed_session_option_is_refused_with_its_replacement(client: httpx.Client, fresh: str):
    reply = post(client, f"/v1/surrogates/{fresh}/sessions", {"caution": 1.0})
    refused(reply, Code.INVALID_REQUEST, "caution: expected no entry of this name, got 1.0; 'caution' was removed: use")


@pytest.mark.parametrize("content", [b"", b"no model", b"\x80\x04K\x01.", (2**40).to_bytes(8, "little") + b"{}"])
def test_importing_a_file_that_is_not_a_model_is_refused(client: httpx.Client, taught: str, content: bytes):
    before = client.get(f"/v1/surrogates/{taught}/models").json()
    reply = client.post(f"/v1/surrogates/{taught}/models", content=content, headers={"content-type": FILE})
    refused(reply, Code.INVALID_REQUEST, "expected")
    assert client.get(f"/v1/surrogates/{taught}/models").json() == before


def test_improving_by_visited_states_of_an_unknown_checkpoint_is_refused(client: httpx.Client, taught: str):
    body = {"queries": 1, "checkpoint": "never"}
    refused(post(client, f"/v1/surrogates/{taught}/improve", body), Code.INVALID_REQUEST, "'never'")


# Sessions


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ({"action": [[0.0]]}, "action: expected shape (2, 1), got (1, 1)"),
        ({"action": [[0.0, 0.0], [0.0, 0.0]]}, "action: expected shape (2, 1), got (2, 2)"),
        ({"action": [[0.0], [0.0, 0.0]]}, "rows of equal length"),
        ({"action": [[2.1], [0.0]]}, "expected entry 0 in [-2, 2], got 2.1 in row 0"),
        ({"action": [[float("nan")], [0.0]]}, "finite number, got nan"),
        ({"action": [[float("inf")], [0.0]]}, "finite number, got inf"),
        ({"action": [["1"], [0.0]]}, "expected a number, got '1'"),
        ({"action": [[0.0], [0.0]], "mask": [True]}, "mask: expected 2 entries, one for each lane, got 1"),
        ({"action": [[0.0], [0.0]], "mask": [1, 0]}, "true or false, got 1"),
        ({"action": [[0.0], [0.0]], "speed": 3}, "speed: expected no entry of this name, got 3"),
        ({}, "action: expected a value, got nothing"),
        ({"action": [[0.0], [0.0]], "seq": 0}, "greater than or equal to 1, got 0"),
    ],
)
def test_an_invalid_step_is_refused_and_the_session_continues(client: httpx.Client, session: str, body: Any, said: str):
    post(client, f"/v1/sessions/{session}/reset", {"seq": 1}).raise_for_status()
    reply = post(client, f"/v1/sessions/{session}/step", {"seq": 2, **body})
    refused(reply, Code.INVALID_REQUEST, said)
    assert client.get(f"/v1/sessions/{session}").json()["seq"] == 1
    post(client, f"/v1/sessions/{session}/step", {"seq": 2, "action": [[0.0], [0.0]]}).raise_for_status()


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ({"seed": [1]}, "seed: expected a whole number, or 2 of them, one for each lane, got a list of 1"),
        ({"seed": -1}, "greater than or equal to 0, got -1"),
        ({"seed": 1.5}, "whole number"),
        ({"mask": [True]}, "mask: expected 2 entries, one for each lane, got 1"),
    ],
)
def test_an_invalid_reset_is_refused_and_the_session_is_unchanged(
    client: httpx.Client, session: str, body: Any, said: str
):
    refused(post(client, f"/v1/sessions/{session}/reset", body), Code.INVALID_REQUEST, said)
    assert client.get(f"/v1/sessions/{session}").json()["seq"] == 0


def test_a_step_before_the_first_reset_is_refused(client: httpx.Client, session: str):
    reply = post(client, f"/v1/sessions/{session}/step", {"seq": 1, "action": [[0.0], [0.0]]})
    refused(reply, Code.NOT_RESET, "lanes [0, 1]")
    post(client, f"/v1/sessions/{session}/reset", {"seq": 1}).raise_for_status()


def test_a_rollout_with_one_invalid_action_takes_no_step(client: httpx.Client, session: str):
    post(client, f"/v1/sessions/{session}/reset", {"seq": 1}).raise_for_status()
    body = {"seq": 2, "actions": [[[0.0], [0.0]], [[0.0], [9.0]]]}
    refused(post(client, f"/v1/sessions/{session}/rollout", body), Code.INVALID_REQUEST, "got 9")
    assert client.get(f"/v1/sessions/{session}").json()["seq"] == 1


POLICY = {"mean": [0, 0, 0], "deviation": [1, 1, 1], "layers": [{"weights": [[1], [1], [1]], "bias": [0]}]}
ROLL = {"policy": POLICY, "steps": 2}


def with_layers(count: int, units: int) -> dict[str, Any]:
    middle = {"weights": [[0.1] * units] * units, "bias": [0.1] * units}
    first = {"weights": [[0.1] * units] * 3, "bias": [0.1] * units}
    return {**ROLL, "policy": {**POLICY, "layers": [first, *[middle] * (count - 1)]}}


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ({}, "expected either actions or a policy, got neither"),
        ({**ROLL, "actions": [[[0.0], [0.0]]]}, "expected either actions or a policy, got both"),
        ({"policy": POLICY}, "got a policy without steps"),
        ({"actions": [[[0.0], [0.0]]], "noise": {"seed": 0}}, "expected 'noise' and 'until' only with a policy"),
        ({**ROLL, "steps": 0}, "steps"),
        ({**ROLL, "until": [True]}, "until: expected 2 entries, one for each lane, got 1"),
        ({**ROLL, "noise": {"seed": -1}}, "seed"),
        ({**ROLL, "noise": {"seed": 0}}, "expected log_deviations with noise, got none"),
        ({**ROLL, "noise": {"seed": 0}, "policy": {**POLICY, "log_deviations": [81]}}, "between -80 and 80, got 81"),
        ({**ROLL, "policy": {**POLICY, "mean": [0, 0]}}, "expected deviation of shape (2,), got (3,)"),
        ({**ROLL, "policy": {**POLICY, "deviation": [1, 0, 1]}}, "expected numbers above 0 in deviation, got 0"),
        ({**ROLL, "policy": {**POLICY, "mean": [0, 0, 1e300]}}, "finite numbers in mean"),
        ({**ROLL, "policy": {**POLICY, "mean": [0, 0, float("nan")]}}, "finite"),
        ({**ROLL, "policy": {**POLICY, "layers": []}}, "layers"),
        ({**ROLL, "policy": {**POLICY, "activation": "exec"}}, "activation"),
        ({**ROLL, "policy": {**POLICY, "code": "1"}}, "code"),
        ({**ROLL, "policy": {**POLICY, "layers": [{"weights": [[1], [1, 2], [1]], "bias": [0]}]}}, "equal length"),
        ({**ROLL, "policy": {**POLICY, "layers": [{"weights": [[1], [1]], "bias": [0]}]}}, "shape (3, 1), got (2, 1)"),
        (with_layers(9, 1), "at most 8"),
        (with_layers(1, 1_025), "1024"),
    ],
)
def test_a_rollout_with_an_invalid_policy_is_refused(client: httpx.Client, session: str, body: Any, said: str):
    post(client, f"/v1/sessions/{session}/reset", {"seq": 1}).raise_for_status()
    refused(post(client, f"/v1/sessions/{session}/rollout", {"seq": 2, **body}), Code.INVALID_REQUEST, said)
    assert client.get(f"/v1/sessions/{session}").json()["seq"] == 1


def test_the_refusal_of_a_policy_too_large_for_json_recommends_msgpack(client: httpx.Client, session: str):
    reply = post(client, f"/v1/sessions/{session}/rollout", with_layers(8, 100))
    refused(reply, Code.TOO_LARGE, "131072 bytes", "send a larger body as application/vnd.msgpack")


@pytest.mark.parametrize(
    ("body", "code"),
    [
        ({"num_envs": 0}, Code.INVALID_REQUEST),
        ({"num_envs": 2**20 + 1}, Code.INVALID_REQUEST),
        ({"num_envs": 65_537}, Code.TOO_LARGE),
        ({"num_envs": 60_000, "variant": "probabilistic"}, Code.TOO_LARGE),
        ({"variant": "quantum"}, Code.INVALID_REQUEST),
        ({"trust": 0}, Code.INVALID_REQUEST),
        ({"trust": -1.0}, Code.INVALID_REQUEST),
        ({"process_noise": 1}, Code.INVALID_REQUEST),
        ({"particles": 5}, Code.INVALID_REQUEST),
        ({"variant": "pathwise", "spread": 0.0}, Code.INVALID_REQUEST),
        ({"propagation": "mean"}, Code.INVALID_REQUEST),
        ({"model": 99}, Code.UNKNOWN_MODEL),
        ({"penalty": float("nan")}, Code.INVALID_REQUEST),
    ],
)
def test_opening_a_session_with_invalid_options_is_refused(client: httpx.Client, taught: str, body: Any, code: Code):
    refused(post(client, f"/v1/surrogates/{taught}/sessions", body), code)


# Bodies


@pytest.mark.parametrize("path", ["/v1/surrogates", "/v1/sessions/nobody/step"])
@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'"x"', b"\xff\xfe", b"[" * 100_000, b'{"seq": ' + b"9" * 9_999])
def test_a_request_body_that_is_not_a_json_object_is_refused(client: httpx.Client, path: str, content: bytes):
    reply = client.post(path, content=content, headers={"content-type": "application/json"})
    assert 400 <= reply.status_code < 500
    assert reply.headers["content-type"] == PROBLEM_MEDIA_TYPE


@pytest.mark.parametrize("content_type", ["text/plain", "application/x-www-form-urlencoded", None])
def test_json_sent_with_a_form_content_type_is_refused(client: httpx.Client, session: str, content_type: str | None):
    headers = {"content-type": content_type} if content_type else {}
    reply = client.post(f"/v1/sessions/{session}/reset", content=b"{}", headers=headers)
    refused(reply, Code.UNSUPPORTED_MEDIA_TYPE, "application/json")
    reply = client.post("/v1/surrogates", content=b"{}", headers=headers)
    refused(reply, Code.UNSUPPORTED_MEDIA_TYPE, "application/json")


def test_a_request_body_over_the_size_limit_is_refused(client: httpx.Client, session: str):
    bodies = {f"/v1/sessions/{session}/step": "application/vnd.msgpack", "/v1/surrogates/x/models": FILE}
    for path, content_type in bodies.items():
        reply = client.post(path, content=b" " * (MAX_BODY + 1), headers={"content-type": content_type})
        refused(reply, Code.TOO_LARGE, f"at most {MAX_BODY} bytes as {content_type}, got {MAX_BODY + 1} bytes")


def test_a_chunked_body_over_the_size_limit_is_refused(client: httpx.Client, session: str):
    def chunks() -> Iterator[bytes]:
        for _ in range(MAX_BODY // 2**20 + 1):
            yield b" " * 2**20

    bodies = {f"/v1/sessions/{session}/step": "application/vnd.msgpack", "/v1/surrogates": "application/json"}
    for path, content_type in bodies.items():
        reply = client.post(path, content=chunks(), headers={"content-type": content_type})
        refused(reply, Code.TOO_LARGE, "at most")


def test_a_json_body_that_is_not_utf_8_is_refused(client: httpx.Client):
    reply = client.post("/v1/surrogates", content=b"\xff\xfe{", headers={"content-type": "application/json"})
    refused(reply, Code.INVALID_REQUEST, "expected JSON in UTF-8")
    assert reply.status_code == 422


def test_every_regular_expression_of_the_api_has_a_description_in_words(client: httpx.Client):
    """A name with a space was refused by a regular expression."""
    patterns = set(entries(client.get("/openapi.json").json(), "pattern"))
    assert patterns
    assert patterns <= IN_WORDS.keys()


def entries(node: Any, key: str) -> Iterator[str]:
    """All texts under ``key`` in a value from JSON."""
    if isinstance(node, dict):
        yield from (value for name, value in node.items() if name == key and isinstance(value, str))
        node = list(node.values())
    for inner in node if isinstance(node, list) else ():
        yield from entries(inner, key)


def test_a_name_with_a_space_is_refused_with_the_allowed_characters(client: httpx.Client):
    refused(
        client.post("/v1/surrogates", json={"name": "my tank", "spec": pendulum.spec()}),
        Code.INVALID_REQUEST,
        "name: expected 1 to 64 letters, digits, '.', '_' or '-'",
        "got 'my tank'",
    )
