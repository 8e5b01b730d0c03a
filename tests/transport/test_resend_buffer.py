"""After a session host died, the client sends its last requests again, or gives the session up. Over real sockets."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest

from support.scripted_server import Answer, ScriptedServer, problem, reply, scripted_server, session_view
from surrogym_client import errors
from surrogym_client.transport import HttpSurrogate, Retries
from surrogym_client.transport.http_surrogate import MAX_BYTES, ResendBuffer, Sent
from surrogym_shared import wire
from surrogym_shared.codes import Code

QUICK = Retries(seconds=2.0, first_delay=0.01, longest_delay=0.05)


def step(seq: int, reward: float = 1.0) -> Answer:
    answer = wire.StepReply(
        seq=seq,
        observation=[[0.1, 0.2], [0.3, 0.4]],
        reward=[reward, 2.0],
        terminated=[False, False],
        truncated=[False, False],
        final_lanes=[],
        final_observation=[],
        model_version=[1, 2],
        reward_mean=[1.5, 2.5],
    )
    return reply(answer.model_dump_json())


def back_to(seq: int) -> Answer:
    return problem(Code.SEQ_CONFLICT, expected_seq=seq)


def opened(server: ScriptedServer) -> HttpSurrogate:
    port = HttpSurrogate(server.url, "pendulum", retries=QUICK, transport="json")
    port.open(wire.OpenSession(num_envs=2))
    return port


def take(port: HttpSurrogate, number: int) -> None:
    port.step("abc", np.full((2, 1), number / 10))


def sent(server: ScriptedServer) -> list[tuple[int, float]]:
    posts = [json.loads(received.body) for received in server.received[1:] if received.method == "POST"]
    return [(body["seq"], body["action"][0][0]) for body in posts]


def test_a_session_reset_to_an_earlier_step_gets_the_later_requests_again():
    script = (step(1), step(2), step(3), back_to(2), step(2), step(3), step(4), step(5))
    with scripted_server(session_view(replay=10), *script) as server, opened(server) as port:
        for number in range(1, 6):
            take(port, number)
    order = [1, 2, 3, 4, 2, 3, 4, 5]
    assert sent(server) == [(number, pytest.approx(number / 10)) for number in order]


def test_a_pickled_client_can_repeat_the_requests_of_the_original():
    script = (step(1), step(2), back_to(1), step(1), step(2), step(3))
    with scripted_server(session_view(replay=10), *script) as server, opened(server) as port:
        take(port, 1)
        take(port, 2)
        with pickle.loads(pickle.dumps(port)) as again:
            take(again, 3)
        assert [seq for seq, _ in sent(server)] == [1, 2, 3, 1, 2, 3]


def test_a_session_may_fall_back_to_an_earlier_step_again_while_requests_are_repeated():
    script = (step(1), step(2), back_to(2), back_to(1), back_to(1), step(1), step(2), step(3))
    with scripted_server(session_view(replay=10), *script) as server, opened(server) as port:
        for number in range(1, 4):
            take(port, number)
    assert [seq for seq, _ in sent(server)] == [1, 2, 3, 2, 3, 1, 2, 3]


@pytest.mark.parametrize(
    ("kept", "replay", "said"),
    [
        (2, (), "from number 1 on again, which this client no longer keeps"),
        (10, (step(1, 9.0),), "answers the repeated request 1 differently"),
    ],
)
def test_a_session_that_cannot_be_restored_exactly_is_reported_lost(kept: int, replay: tuple[Answer, ...], said: str):
    script = (step(1), step(2), step(3), back_to(1), *replay, reply(""))
    with scripted_server(session_view(replay=kept), *script) as server, opened(server) as port:
        for number in range(1, 4):
            take(port, number)
        with pytest.raises(errors.UnknownSession, match=said):
            take(port, 4)
        assert server.received[-1].method == "DELETE"


def test_a_server_sequence_number_ahead_of_the_client_raises_a_conflict():
    for view in (session_view(replay=10), session_view()):
        with (
            scripted_server(view, step(1), back_to(9)) as server,
            opened(server) as port,
        ):
            take(port, 1)
            with pytest.raises(errors.SeqConflict):
                take(port, 2)


def test_a_session_that_always_falls_back_to_an_earlier_step_raises_a_conflict():
    with scripted_server(session_view(replay=10), step(1), back_to(1)) as server, opened(server) as port:
        take(port, 1)
        with pytest.raises(errors.SeqConflict):
            take(port, 2)


def test_requests_that_a_client_keeps_for_repetition_are_limited_in_number_and_bytes():
    window, size = ResendBuffer(3), MAX_BYTES // 2
    for seq, content in ((1, b"1"), (2, b"2"), (3, b"3"), (4, b"4")):
        window.keep(Sent(seq, "step", content, lambda *_: (0, None), 1.0))
    assert window.since(1) is None
    assert [one.seq for one in window.since(2) or ()] == [2, 3, 4]
    window.keep(Sent(5, "step", bytes(size), lambda *_: (0, None), 1.0))
    window.keep(Sent(6, "step", bytes(size), lambda *_: (0, None), 1.0))
    assert window.since(4) is None
    assert [one.seq for one in window.since(5) or ()] == [5, 6]
