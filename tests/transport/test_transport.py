"""HttpSurrogate sends what the wire says and repeats a step only under its seq. Over real sockets."""

import json
import pickle

import numpy as np
import pytest

from support.scripted_server import Answer, ScriptedServer, lost_reply, problem, reply, scripted_server, session_view
from surrogym_client import errors
from surrogym_client.transport import HttpSurrogate, Retries
from surrogym_shared import wire
from surrogym_shared.codes import Code
from surrogym_shared.port import SurrogatePort

QUICK = Retries(seconds=2.0, first_delay=0.01, longest_delay=0.05)


def step_reply(seq: int) -> wire.StepReply:
    return wire.StepReply(
        seq=seq,
        observation=[[0.1, 0.2], [0.3, 0.4]],
        reward=[1.0, 2.0],
        terminated=[False, True],
        truncated=[False, False],
        final_lanes=[1],
        final_observation=[[5.0, 6.0]],
        model_version=[1, 2],
        reward_mean=[1.5, 2.5],
    )


def step(seq: int) -> Answer:
    return reply(step_reply(seq).model_dump_json())


def surrogate(server: ScriptedServer) -> HttpSurrogate:
    return HttpSurrogate(server.url, "pendulum", retries=QUICK, transport="json")


def bodies(server: ScriptedServer) -> list[dict[str, object]]:
    return [json.loads(received.body) for received in server.received]


ACTION = np.array([[0.5], [-0.5]], dtype=np.float32)


def test_the_http_surrogate_implements_the_surrogate_interface():
    assert isinstance(HttpSurrogate(None, "pendulum"), SurrogatePort)


def test_a_lost_reply_is_requested_again_with_the_same_sequence_number():
    with scripted_server(session_view(), lost_reply, step(1), step(2)) as server, surrogate(server) as port:
        session = port.open(wire.OpenSession(num_envs=2)).id
        port.step(session, ACTION)
        port.step(session, ACTION)
        assert [body["seq"] for body in bodies(server)[1:]] == [1, 1, 2]
        assert bodies(server)[1] == bodies(server)[2]


def test_a_refused_step_leaves_the_sequence_number_unchanged():
    with scripted_server(session_view(), problem(Code.NOT_RESET), step(1)) as server, surrogate(server) as port:
        session = port.open(wire.OpenSession(num_envs=2)).id
        with pytest.raises(errors.NotReset):
            port.step(session, ACTION)
        port.step(session, ACTION)
        assert [body["seq"] for body in bodies(server)[1:]] == [1, 1]


def test_requests_of_the_client_match_the_server_schemas():
    reset = reply(wire.ResetReply(seq=1, observation=[[0, 0]] * 2, model_version=[1, 1]).model_dump_json())
    rollout = reply(wire.RolloutReply(seq=3, steps=[step_reply(3)] * 2).model_dump_json())
    with scripted_server(session_view(), reset, step(2), rollout) as server, surrogate(server) as port:
        port.open(wire.OpenSession(num_envs=2, seed=0))
        port.reset("abc", seed=[np.int64(3), 4], mask=np.array([True, False]))
        port.step("abc", ACTION, mask=np.array([True, False]), deviations=True)
        results = port.rollout("abc", np.stack([ACTION, ACTION]))
    opened, *rest = (received.body for received in server.received)
    assert wire.OpenSession.model_validate_json(opened).idempotency_key
    expected = [
        wire.ResetSession(seq=1, seed=[3, 4], mask=[True, False]),
        wire.StepSession(seq=2, action=[[0.5], [-0.5]], mask=[True, False], deviations=True),
        wire.RolloutSession(seq=3, actions=[[[0.5], [-0.5]]] * 2),
    ]
    assert [type(e).model_validate_json(body) for e, body in zip(expected, rest, strict=True)] == expected
    assert len(results) == 2


def test_a_json_step_reply_is_converted_to_arrays():
    with scripted_server(session_view(), step(1)) as server, surrogate(server) as port:
        port.open(wire.OpenSession(num_envs=2))
        result = port.step("abc", ACTION)
    np.testing.assert_array_equal(result.observation, np.float32([[0.1, 0.2], [0.3, 0.4]]))
    assert result.observation.dtype == np.float32
    np.testing.assert_array_equal(result.terminated, [False, True])
    np.testing.assert_array_equal(result.final_lanes, [1])
    np.testing.assert_array_equal(result.final_observation, np.float32([[5, 6]]))
    np.testing.assert_array_equal(result.model_version, [1, 2])
    np.testing.assert_array_equal(result.reward_mean, [1.5, 2.5])
    assert result.deviation is None


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.array([[0.0], [np.nan]]), r"action\[1, 0\]: expected a finite number, got nan"),
        (np.array([[np.inf], [0.0]]), r"action\[0, 0\]: expected a finite number, got inf"),
        (np.array([["left"], ["right"]]), r"expected an array of numbers, got dtype <U5"),
    ],
)
def test_values_that_json_cannot_express_are_refused_before_sending(action: np.ndarray, message: str):
    with scripted_server(session_view()) as server, surrogate(server) as port:
        port.open(wire.OpenSession(num_envs=2))
        with pytest.raises(errors.InvalidInput, match=message):
            port.step("abc", action)
        assert len(server.received) == 1


def test_another_client_continues_a_session_it_did_not_open():
    with scripted_server(session_view(seq=41), step(42)) as server, surrogate(server) as port:
        port.step("abc", ACTION)
        assert bodies_of_posts(server)[0]["seq"] == 42


def bodies_of_posts(server: ScriptedServer) -> list[dict[str, object]]:
    return [json.loads(received.body) for received in server.received if received.method == "POST"]


def test_a_pickled_client_continues_its_session():
    with scripted_server(session_view(), step(1), step(2)) as server, surrogate(server) as port:
        port.open(wire.OpenSession(num_envs=2))
        port.step("abc", ACTION)
        with pickle.loads(pickle.dumps(port)) as again:
            again.step("abc", ACTION)
        assert bodies(server)[-1]["seq"] == 2


def test_a_server_of_an_older_or_newer_protocol_is_refused():
    with (
        scripted_server(session_view(protocol=wire.PROTOCOL + 1)) as server,
        surrogate(server) as port,
        pytest.raises(errors.ProtocolMismatch, match=r"expected protocol 1 .* got 2"),
    ):
        port.open(wire.OpenSession())


@pytest.mark.parametrize("body", ['{"seq": 1}', "not json", step_reply(1).model_dump_json()[:-1] + ',"more":1}'])
def test_a_json_reply_that_is_not_a_step_is_refused(body: str):
    with scripted_server(session_view(), reply(body)) as server, surrogate(server) as port:
        port.open(wire.OpenSession(num_envs=2))
        with pytest.raises(errors.ProtocolMismatch, match="/v1/sessions/abc/step"):
            port.step("abc", ACTION)


def test_closing_the_last_session_closes_its_sockets():
    with scripted_server(session_view(), step(1), reply(""), session_view(seq=4), step(5)) as server:
        port = surrogate(server)
        port.open(wire.OpenSession(num_envs=2))
        port.step("abc", ACTION)
        port.close("abc")
        assert port.connection._client.is_closed
        port.step("def", ACTION)  # a session that another client opened: this one connects anew
        port.disconnect()


def test_a_lost_session_leaves_no_socket_open():
    with scripted_server(session_view(), problem(Code.SESSION_EXPIRED), reply("")) as server:
        port = surrogate(server)
        port.open(wire.OpenSession(num_envs=2))
        with pytest.raises(errors.SessionExpired):
            port.step("abc", ACTION)
        port.close("another")
        assert port.connection._client.is_closed


def test_closing_an_unknown_session_is_harmless():
    with scripted_server(problem(Code.UNKNOWN_SESSION)) as server, surrogate(server) as port:
        port.close("abc")
        assert server.received[0].method == "DELETE"
