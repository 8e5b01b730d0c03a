"""Priors over HTTP: one of the same plant is taken, another is refused by name, and a refusal changes nothing."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import surrogym
from support.hinge import Textbook, hinge_spec, sent, steps_of
from support.server import ServerProcess
from surrogym_client.errors import InvalidInput, SurrogymClientError, UnknownSurrogate
from surrogym_client.surrogates.waiting import wait_for_model
from surrogym_client.transport import Api
from surrogym_client.transport.priors import PriorCalls
from surrogym_sampler.original.classic import pendulum
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.surrogate_file import SurrogateFile

SPEC = hinge_spec(design={"budget": 40, "initial": 2})


@pytest.fixture
def api(server_process: ServerProcess) -> Iterator[Api]:
    with Api(server_process.url) as opened:
        yield opened


@pytest.fixture
def surrogate(api: Api, name: str) -> Iterator[str]:
    api.create_surrogate(name, hinge_spec(design={"budget": 0}))
    yield name
    api.delete_surrogate(name)


def file_of(spec: EnvironmentSpec = SPEC) -> SurrogateFile:
    design = surrogym.Design(spec)
    design.tell(None, steps_of(Textbook(), 40, seed=1))
    while (query := design.ask()) is not None:
        design.give_up(query)
    return design.to_file("textbook")


@pytest.fixture(scope="module")
def textbook() -> SurrogateFile:
    return file_of()


def test_the_next_model_after_storing_a_prior_uses_the_prior(api: Api, surrogate: str, textbook: SurrogateFile):
    calls = PriorCalls(api.connection)
    assert calls.get(surrogate) == calls.get(surrogate).model_copy(update={"awaited": False, "about": None})
    stored = calls.put(surrogate, textbook.to_bytes())
    assert stored.about is not None
    assert stored.about.source == "textbook"
    sent(api, surrogate, 6)
    view = wait_for_model(api, surrogate, 60)
    assert view.fidelity is not None
    assert any(output.structure.startswith("prior + ") for output in view.fidelity.outputs)
    calls.drop(surrogate)
    sent(api, surrogate, 7)
    view = wait_for_model(api, surrogate, 60)
    assert view.fidelity is not None
    assert not any(output.structure.startswith("prior + ") for output in view.fidelity.outputs)


def test_a_design_waits_for_an_announced_prior_before_the_first_fit(api: Api, surrogate: str, textbook: SurrogateFile):
    calls = PriorCalls(api.connection)
    assert calls.wait(surrogate).awaited
    sent(api, surrogate, 6)
    assert api.surrogate(surrogate).model_version is None
    assert not calls.put(surrogate, textbook.to_bytes()).awaited
    assert wait_for_model(api, surrogate, 60).model_version == 1


def test_a_prior_of_another_plant_is_refused_with_the_first_difference(api: Api, surrogate: str):
    design = surrogym.Design(pendulum().model_copy(update={"design": SPEC.design}))
    while (query := design.ask()) is not None and design.steps < 2:
        design.tell(query, surrogym.RealStep(query.coordinates, query.action, query.coordinates, -1.0))
    with pytest.raises(InvalidInput, match=r"coordinates\.0\.name"):
        PriorCalls(api.connection).put(surrogate, design.to_file("pendulum").to_bytes())


def test_a_prior_in_other_units_is_refused(api: Api, surrogate: str, textbook: SurrogateFile):
    spec = textbook.spec.model_dump()
    spec["coordinates"][1]["unit"] = "deg/s"
    other = SurrogateFile("deg", EnvironmentSpec.model_validate(spec), textbook.model, textbook.samples)
    with pytest.raises(InvalidInput, match=r"coordinates\.1\.unit"):
        PriorCalls(api.connection).put(surrogate, other.to_bytes())
    assert PriorCalls(api.connection).get(surrogate).about is None


@pytest.mark.parametrize("body", [b"", b"no file", bytes(100)], ids=["empty", "text", "zeros"])
def test_a_body_that_is_not_a_prior_file_is_refused(api: Api, surrogate: str, body: bytes):
    with pytest.raises(InvalidInput, match="expected a"):
        PriorCalls(api.connection).put(surrogate, body)


def test_a_prior_with_an_invalid_description_is_refused(api: Api, surrogate: str, textbook: SurrogateFile):
    other = SurrogateFile("x", textbook.spec, textbook.model, textbook.samples, about={"source": "a\x07b"})
    with pytest.raises(InvalidInput, match="description of the prior"):
        PriorCalls(api.connection).put(surrogate, other.to_bytes())


def test_a_prior_for_a_model_family_without_prior_support_is_refused(api: Api, name: str, textbook: SurrogateFile):
    api.create_surrogate(name, hinge_spec(design={"budget": 0, "model": "ensemble"}))
    try:
        with pytest.raises(InvalidInput, match="ensemble"):
            PriorCalls(api.connection).put(name, textbook.to_bytes())
        with pytest.raises(InvalidInput, match="ensemble"):
            PriorCalls(api.connection).wait(name)
    finally:
        api.delete_surrogate(name)


def test_a_prior_for_an_unknown_surrogate_is_refused_with_its_name(api: Api, textbook: SurrogateFile):
    calls = PriorCalls(api.connection)
    for call in (calls.get, calls.wait, calls.drop):
        with pytest.raises(UnknownSurrogate, match="nobody"):
            call("nobody")
    with pytest.raises(SurrogymClientError):
        calls.put("nobody", textbook.to_bytes())
