"""The stream of events: everything that happened, once, in order, and going on where a reader left off."""

from __future__ import annotations

import itertools

import httpx
import pytest

from support import pendulum
from surrogym_shared.wire import Event


def read(client: httpx.Client, name: str, count: int, **headers: str) -> list[Event]:
    with client.stream("GET", f"/v1/surrogates/{name}/events", headers=headers) as stream:
        lines = (line for line in stream.iter_lines() if line.startswith("data: "))
        found = itertools.islice(lines, count)
        return [Event.model_validate_json(line.removeprefix("data: ")) for line in found]


def test_creation_query_and_sample_of_a_surrogate_are_reported_as_events_in_order(client: httpx.Client, fresh: str):
    query = pendulum.claim(client, fresh, max_queries=1)["queries"][0]
    pendulum.add(client, fresh, [pendulum.answer(query)]).raise_for_status()
    events = read(client, fresh, 3, **{"last-event-id": "0"})
    assert [event.kind for event in events] == ["created", "queries", "sample"]
    assert [event.id for event in events] == sorted({event.id for event in events})


def test_an_event_stream_resumes_after_the_given_last_event_id(client: httpx.Client, fresh: str):
    first, second = read(client, fresh, 2, **{"last-event-id": "0"})
    assert read(client, fresh, 1, **{"last-event-id": str(first.id)}) == [second]


def test_an_event_stream_without_last_event_id_reports_only_new_events(client: httpx.Client, fresh: str):
    with client.stream("GET", f"/v1/surrogates/{fresh}/events") as stream:
        lines = stream.iter_lines()
        assert next(lines).startswith(":")
        body = {"steps": 5, "idempotency_key": "k"}
        client.post(f"/v1/surrogates/{fresh}/ledger", json=body).raise_for_status()
        data = next(line for line in lines if line.startswith("data: "))
    assert Event.model_validate_json(data.removeprefix("data: ")).kind == "ledger"


@pytest.mark.timeout(60)
def test_deleting_a_surrogate_ends_its_event_stream(client: httpx.Client, fresh: str):
    with client.stream("GET", f"/v1/surrogates/{fresh}/events") as stream:
        lines = stream.iter_lines()
        next(lines)
        client.delete(f"/v1/surrogates/{fresh}").raise_for_status()
        assert not [line for line in lines if line.startswith("data: ")]


def test_the_common_event_stream_reports_changes_of_every_surrogate(client: httpx.Client, fresh: str):
    with client.stream("GET", "/v1/events") as stream:
        lines = stream.iter_lines()
        assert next(lines).startswith(":")
        body = {"steps": 5, "idempotency_key": "any"}
        client.post(f"/v1/surrogates/{fresh}/ledger", json=body).raise_for_status()
        client.patch(f"/v1/surrogates/{fresh}", json={"budget": 20}).raise_for_status()
        assert next(line for line in lines if line) == "event: changed"
