"""Api: keys that make repeats harmless, pages, and events that survive a broken stream. Over real sockets."""

import inspect
import json
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from support.scripted_server import ScriptedServer, lost_reply, problem, reply, scripted_server
from surrogym_client import errors
from surrogym_client.transport import Api, HttpSurrogate, Retries
from surrogym_shared import wire
from surrogym_shared.codes import Code

QUICK = Retries(seconds=2.0, first_delay=0.01, longest_delay=0.05)
SAMPLE = wire.NewSample(coordinates=[0.0], action=[0.0], next_coordinates=[0.1], reward=1.0, terminated=False)


@contextmanager
def api_of(*script) -> Iterator[tuple[Api, ScriptedServer]]:
    with scripted_server(*script) as server, Api(server.url, retries=QUICK) as api:
        yield api, server


def said(model: wire.Reply):
    return reply(model.model_dump_json())


def sample(number: int) -> wire.SampleView:
    return wire.SampleView(
        id=number,
        purpose="initial",
        query_id=number,
        sampler="a",
        attempt=1,
        late=False,
        trajectory=None,
        step=0,
        requested_coordinates=[0.0],
        coordinates=[0.0],
        action=[0.0],
        next_coordinates=[0.1],
        reward=1.0,
        terminated=False,
        truncated=False,
        created_at=0.0,
    )


def test_samples_are_resent_with_their_idempotency_key_after_a_lost_reply():
    added = said(wire.AddedSamples(sample_ids=[1], duplicates=1, ledger=wire.Ledger(manual=1, total=1)))
    with api_of(lost_reply, added, added) as (api, server):
        api.add_samples("pendulum", "me", [SAMPLE])
        api.add_samples("pendulum", "me", [SAMPLE])
    keys = [wire.AddSamples.model_validate_json(r.body).idempotency_key for r in server.received]
    assert keys[0] == keys[1] != keys[2]


def test_the_client_reports_which_samples_were_stored_before_a_refusal():
    """A caller that can tell the stored samples from the others loses none and sends none in vain."""
    many, stored = [SAMPLE] * 1500, list[wire.AddedSamples]()
    first = wire.AddedSamples(sample_ids=[1], duplicates=0, ledger=wire.Ledger(manual=1, total=1))
    with api_of(said(first), problem(Code.TOO_LARGE)) as (api, server):
        with pytest.raises(errors.TooLarge):
            api.add_samples("pendulum", "me", many, purpose="logged", stored=stored.append)
        assert [one.sample_ids for one in stored] == [[1]]
        assert [wire.AddSamples.model_validate_json(r.body).complete for r in server.received] == [False, False]


def test_a_request_for_queries_is_not_repeated_after_a_lost_reply():
    with api_of(lost_reply) as (api, server):
        with pytest.raises(errors.ServerUnreachable):
            api.claim("pendulum", "me")
        assert len(server.received) == 1


def test_the_client_reads_all_pages_of_samples():
    full = wire.SamplePage(samples=[sample(1), sample(2)], next_after=2)
    last = wire.SamplePage(samples=[], next_after=None)
    with api_of(said(full), said(last)) as (api, server):
        assert [s.id for s in api.samples("a.b")] == [1, 2]
    assert [r.path for r in server.received] == [f"/v1/surrogates/a.b/samples?after={n}" for n in (0, 2)]


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "a%2Fb", "../sessions", "a b", "a?b", "a#b", "a\n", "x" * 65])
def test_an_invalid_surrogate_name_is_refused_without_a_request(name: str):
    with api_of(reply("{}")) as (api, server):
        remote = HttpSurrogate(server.url, name)
        calls = [
            lambda: api.surrogate(name),
            lambda: api.delete_surrogate(name),
            lambda: api.import_model(name, b""),
            lambda: list(api.samples(name)),
            lambda: list(api.events(name)),
            remote.spec,
            lambda: remote.open(wire.OpenSession(num_envs=1)),
        ]
        for call in calls:
            with pytest.raises(errors.InvalidInput, match="expected 1 to 64 letters, digits") as refusal:
                call()
            assert repr(name) in str(refusal.value)
        assert server.received == []


@pytest.mark.parametrize("identity", ["", ".", "..", "a/b", "../surrogates", "a\\b"])
def test_an_invalid_session_id_is_refused_without_a_request(identity: str):
    with api_of(reply("{}")) as (api, server):
        remote = HttpSurrogate(api.url, "pendulum")
        for call in (remote.reset, remote.close):
            with pytest.raises(
                errors.InvalidInput, match="expected no slash, and at least one character other than a dot"
            ):
                call(identity)
        assert server.received == []


@pytest.mark.parametrize(("identity", "sent"), [("-2aay_C", "-2aay_C"), ("a b%2Fc", "a%20b%252Fc"), ("a..", "a..")])
def test_session_ids_are_url_quoted_in_requests(identity: str, sent: str):
    with api_of(reply("")) as (api, server):
        HttpSurrogate(api.url, "pendulum").close(identity)
        assert [request.path for request in server.received] == [f"/v1/sessions/{sent}"]


def event(number: int) -> str:
    body = wire.Event(id=number, kind="sample", created_at=0.0, body={}).model_dump_json()
    return f"id: {number}\nevent: sample\ndata: {body}\n\n"


def summary(name: str) -> wire.SurrogateSummary:
    return wire.SurrogateSummary(
        name=name,
        environment="",
        phase="collecting",
        paused=False,
        round=0,
        samples=0,
        model_version=None,
        confidence_index=None,
        target=0.999,
        budget=10,
        ledger=wire.Ledger(),
        queries=wire.QueryCounts(),
        created_at=0.0,
    )


def test_the_client_reads_all_pages_of_the_surrogate_list():
    pages = [
        wire.SurrogateList(surrogates=[summary("a")], next_after=7),
        wire.SurrogateList(surrogates=[summary("b")]),
    ]
    with api_of(*map(said, pages)) as (api, server):
        assert [found.name for found in api.surrogates()] == ["a", "b"]
    assert [request.path for request in server.received] == ["/v1/surrogates?after=0", "/v1/surrogates?after=7"]


def test_a_broken_event_stream_continues_after_the_last_event():
    first = reply(": connected\n\n" + event(1) + event(2), content_type="text/event-stream")
    second = reply(": connected\n\n" + event(3), content_type="text/event-stream")
    gone = problem(Code.UNKNOWN_SURROGATE)
    with api_of(first, lost_reply, second, gone) as (api, server):
        events = api.events("pendulum", after=0)
        assert [next(events).id for _ in range(3)] == [1, 2, 3]
        with pytest.raises(errors.UnknownSurrogate):
            next(events)
    assert [r.headers["Last-Event-ID"] for r in server.received] == ["0", "2", "2", "3"]


def test_fields_not_given_in_a_surrogate_change_are_sent_as_null():
    with api_of(problem(Code.FORBIDDEN)) as (api, server):
        with pytest.raises(errors.Forbidden):
            api.patch_surrogate("pendulum", paused=True)
        assert server.received[0].method == "PATCH"
        body = json.loads(server.received[0].body)
        assert body == {"paused": True, "budget": None, "target": None, "tolerances": None}


def test_a_server_with_another_protocol_version_is_refused():
    newer = said(wire.Health(version="9", protocol=wire.PROTOCOL + 1))
    with (
        api_of(newer) as (api, _),
        pytest.raises(errors.ProtocolMismatch, match=r"expected protocol 1 .* got 2"),
    ):
        api.health()


def test_a_reply_that_does_not_match_its_schema_is_refused():
    other = reply('{"models": [{"version": "first"}]}')
    with (
        api_of(other) as (api, _),
        pytest.raises(errors.ProtocolMismatch, match=r"models.*: models\.0\.version"),
    ):
        api.models("pendulum")


def test_the_client_waits_for_a_server_that_is_starting():
    ready = said(wire.Ready(status="ready", storage="ok"))
    with api_of(problem(Code.UNAVAILABLE), ready, said(wire.Health(version="1"))) as (api, _):
        assert api.wait_until_ready(5.0).version == "1"


def test_every_api_method_has_a_docstring_and_a_return_type():
    methods = {name: member for name, member in vars(Api).items() if callable(member) and not name.startswith("_")}
    assert len(methods) > 20
    for name, method in methods.items():
        assert method.__doc__, name
        assert inspect.signature(method).return_annotation is not inspect.Signature.empty, name
