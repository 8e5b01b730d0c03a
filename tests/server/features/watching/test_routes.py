"""Streams over HTTP: steps are stored once and in order; what does not fit is refused, and changes nothing."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from support import pendulum as small
from support.server import ServerProcess
from surrogym_client.errors import IdempotencyConflict, InvalidInput, UnknownSurrogate
from surrogym_client.transport import Api
from surrogym_client.transport.steps import StepCalls
from surrogym_sampler.original.classic import pendulum
from surrogym_server.errors import IdempotencyConflict as Conflict
from surrogym_server.features.watching import routes, store
from surrogym_server.storage.records import NewSurrogate
from surrogym_server.storage.sql import open_storage
from surrogym_shared.wire.watching import AddSteps, MachineStep

MACHINE = "Pendulum-v1"


def step(number: int, **other: Any) -> MachineStep:
    fields = {
        "coordinates": [0.1, 0.0],
        "action": [0.5],
        "next_coordinates": [0.1 + 0.01 * number, 0.4],
        "reward": -1.0,
    }
    return MachineStep(**{**fields, **other})


@pytest.fixture
def api(server_process: ServerProcess) -> Iterator[Api]:
    with Api(server_process.url) as opened:
        yield opened


@pytest.fixture
def calls(api: Api) -> StepCalls:
    return StepCalls(api.connection)


@pytest.fixture
def surrogate(api: Api, name: str) -> Iterator[str]:
    spec = pendulum()
    api.create_surrogate(name, spec.model_copy(update={"environment": MACHINE, "sampling_period": 0.05}))
    yield name
    api.delete_surrogate(name)


def test_the_openapi_example_of_a_stream_passes_validation():
    AddSteps.model_validate(routes.EXAMPLE)


def test_steps_of_a_stream_are_stored_once_in_order_and_never_learned(api: Api, calls: StepCalls, surrogate: str):
    before = api.surrogate(surrogate)
    first = calls.add(surrogate, MACHINE, "a", 0, [step(i) for i in range(3)])
    again = calls.add(surrogate, MACHINE, "a", 1, [step(i) for i in range(1, 5)], period=0.05)
    other = calls.add(surrogate, MACHINE, "b", 0, [step(0)])
    assert [(one.stored, one.next) for one in (first, again, other)] == [(3, 3), (2, 5), (1, 1)]
    read = calls.after(surrogate)
    assert [(one.stream, one.number) for one in read] == [("a", i) for i in range(5)] + [("b", 0)]
    assert read[4].next_coordinates == [0.1 + 0.01 * 4, 0.4]
    assert [one.id for one in calls.after(surrogate, read[3].id)] == [read[4].id, read[5].id]
    assert calls.after(surrogate, since=time.time() + 60) == []
    now = api.surrogate(surrogate)
    assert (now.samples, now.ledger, now.phase) == (before.samples, before.ledger, before.phase)


@pytest.mark.parametrize(
    ("sent", "named"),
    [
        (lambda add: add(first=4), ["expected step 2", "got step 4"]),
        (lambda add: add(machine="CartPole-v1"), ["expected 'Pendulum-v1'", "got 'CartPole-v1'"]),
        (lambda add: add(period=0.1), ["expected 0.05 s", "got 0.1 s"]),
        (lambda add: add(steps=[step(2), step(3, next_coordinates=[0.1, 4_000.0])]), ["steps.1", "range", "4000"]),
        (lambda add: add(steps=[step(2, action=[50.0])]), ["steps.0", "50"]),
        (lambda add: add(steps=[step(2, coordinates=[0.1])]), ["steps.0.coordinates", "(n, 2)", "(1, 1)"]),
    ],
    ids=["gap", "another machine", "another period", "another unit", "beyond the bounds", "another shape"],
)
def test_unusable_steps_are_refused_with_both_sides_and_change_nothing(
    calls: StepCalls, surrogate: str, sent: Callable[[Callable[..., Any]], Any], named: list[str]
):
    def add(machine: str = MACHINE, first: int = 2, steps: list[MachineStep] | None = None, **other: Any) -> Any:
        return calls.add(surrogate, machine, "a", first, steps or [step(2)], **other)

    calls.add(surrogate, MACHINE, "a", 0, [step(0), step(1)])
    with pytest.raises(InvalidInput) as refused:
        sent(add)
    assert not [words for words in named if words not in str(refused.value)], str(refused.value)
    assert [one.number for one in calls.after(surrogate)] == [0, 1]
    assert add().next == 3


def test_other_steps_under_stored_numbers_are_refused(calls: StepCalls, surrogate: str):
    """A controller that begins again with the same name of the stream loses nothing unnoticed."""
    calls.add(surrogate, MACHINE, "a", 0, [step(0), step(1)])
    with pytest.raises(IdempotencyConflict, match="another stream"):
        calls.add(surrogate, MACHINE, "a", 0, [step(7)])
    assert len(calls.after(surrogate)) == 2


def test_the_largest_request_is_not_too_large(calls: StepCalls, surrogate: str):
    """500 steps of 64 coordinates and actions, the most that a specification can have."""
    most = [-1.2345678901234567e-05] * 64
    largest = [step(0, coordinates=most, action=most, next_coordinates=most)] * 500
    with pytest.raises(InvalidInput, match=r"steps\.0\.coordinates"):
        calls.add(surrogate, MACHINE, "a", 0, largest)


def test_steps_for_an_unknown_surrogate_are_refused(calls: StepCalls):
    with pytest.raises(UnknownSurrogate):
        calls.add("nobody", MACHINE, "a", 0, [step(0)])


def test_only_the_newest_steps_of_a_surrogate_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(store, "KEPT", 3)
    with closing(open_storage(f"sqlite:///{tmp_path / 'surrogym.db'}")) as storage:
        storage.surrogates.create(NewSurrogate("one", small.spec(), small.BUDGET, 0.999))
        streams = storage.part(store.Streams)
        for number in range(5):
            streams.add("one", "a", number, [{"reward": number}])
        assert [one["number"] for one in streams.page("one", 0, 0.0, 10)] == [2, 3, 4]
        assert streams.add("one", "a", 4, [{"reward": 4}]) == (0, 5)
        with pytest.raises(Conflict, match="got step 0 that is not kept any more"):
            streams.add("one", "a", 0, [{"reward": 0}])
        with pytest.raises(Conflict, match="got step 4 with other values than before"):
            streams.add("one", "a", 4, [{"reward": 0}])
