"""How real steps kept limits: each sample is read once, also after others were added and after the name was reused."""

from __future__ import annotations

import asyncio

import pytest

from support import limited
from surrogym_server.services.definitions import Definitions
from surrogym_server.services.notices import Notices
from surrogym_server.services.samples import SampleService
from surrogym_server.storage.records import NewSample, NewSurrogate
from surrogym_server.storage.sql import Storage
from surrogym_shared.limits import KeptSteps

NAME = "cart"


@pytest.fixture
def service(storage: Storage, definitions: Definitions) -> SampleService:
    async def make() -> SampleService:  # notices belong to a running event loop
        return SampleService(storage, definitions, Notices())

    return asyncio.run(make())


def steps(*ends: float) -> list[NewSample]:
    """Steps of a cart that rests where they end."""
    return [NewSample((x, 0.0), (0.0,), (x, 0.0), 0.0, False) for x in ends]


def test_steps_are_counted_once_and_those_that_come_later_too(
    storage: Storage, service: SampleService, monkeypatch: pytest.MonkeyPatch
):
    storage.surrogates.create(NewSurrogate(NAME, limited.SPEC.model_dump(mode="json"), 60, 0.999, ()))
    service.add(NAME, "rig", steps(0.5, 0.7), "first")
    first = service.kept(storage.surrogates.get(NAME), limited.SPEC)
    service.add(NAME, "rig", steps(-1.2), "second")
    read: list[int] = []
    page = service.page
    monkeypatch.setattr(service, "page", lambda *asked: read.append(len(rows := page(*asked))) or rows)
    kept = service.kept(storage.surrogates.get(NAME), limited.SPEC)
    assert (first.steps, first.beyond, first.near) == (2, (0,), 1)
    assert (kept.steps, kept.beyond, kept.near) == (3, (1,), 2)
    assert kept.least == pytest.approx((-0.2,))
    assert kept == KeptSteps().with_steps(limited.SPEC, service.all(NAME)), "as if all were counted at once"
    assert read[:2] == [1, 0], "only the new step is read"
    assert kept.words(limited.SPEC) == [
        "limit rail: 1 of 3 real steps beyond it, least room -0.2, margin 0.4",
        "limits: the fallback was due after 2 of 3 real steps",
    ]


def test_a_surrogate_of_the_same_name_begins_anew(storage: Storage, service: SampleService):
    for end in (-1.2, 0.0):
        storage.surrogates.create(NewSurrogate(NAME, limited.SPEC.model_dump(mode="json"), 60, 0.999, ()))
        service.add(NAME, "rig", steps(end), "only")
        kept = service.kept(storage.surrogates.get(NAME), limited.SPEC)
        storage.surrogates.delete(NAME)
    assert (kept.steps, kept.beyond) == (1, (0,))
