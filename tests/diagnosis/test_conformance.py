"""The conformance suite: our server keeps the protocol; one that breaks a promise fails the check of that promise."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from typer.testing import CliRunner

from support.forging_proxy import Forge, forging_proxy, leave
from support.server import ServerProcess, running_server
from surrogym.cli import build
from surrogym_client.transport import Api
from surrogym_sampler.diagnosis.conformance import checks, conformance


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    with running_server(tmp_path_factory.mktemp("conformance")) as running:
        yield running


def run(url: str, *options: str):
    return CliRunner().invoke(build(), ["conformance", "--server", url, *options])


def test_our_server_passes_the_conformance_suite_and_is_left_unchanged(server: ServerProcess):
    result = run(server.url, "--json")
    assert (result.exit_code, json.loads(result.stdout)["failed"]) == (0, {})
    with Api(server.url) as api:
        assert api.surrogates() == []


def ignore_seq(path: str, body: dict[str, Any]) -> None:
    if path.endswith("/step"):
        body.pop("seq", None)


def ignore_seeds(path: str, body: dict[str, Any]) -> None:
    body.pop("seed", None)


def call_truncation_termination(path: str, body: dict[str, Any]) -> None:
    if "truncated" in body:
        body["terminated"] = [a or b for a, b in zip(body["terminated"], body["truncated"], strict=True)]


def forget_that_it_was_there(path: str, body: dict[str, Any]) -> None:
    if "duplicates" in body:
        body["duplicates"] = 0


def say_only_that_it_failed(path: str, body: dict[str, Any]) -> None:
    if body.get("code") == "invalid_request":
        body["code"] = "internal"


def reset_every_lane(path: str, body: dict[str, Any]) -> None:
    if path.endswith("/reset"):
        body.pop("mask", None)


@pytest.mark.parametrize(
    ("request_", "reply", "broken"),
    [
        (ignore_seq, leave, "any other seq or body is refused"),
        (ignore_seeds, leave, "a seed fixes the starts"),
        (leave, call_truncation_termination, "the time limit truncates and does not terminate"),
        (leave, forget_that_it_was_there, "a late answer is kept once"),
        (leave, say_only_that_it_failed, "bad input is refused and changes nothing"),
        (reset_every_lane, leave, "disabled waits for a reset by mask"),
    ],
)
def test_a_server_that_breaks_a_protocol_rule_fails_the_check_of_that_rule(
    server: ServerProcess, monkeypatch: pytest.MonkeyPatch, request_: Forge, reply: Forge, broken: str
):
    monkeypatch.setattr(checks, "WITH_MODEL", checks.WITH_MODEL[:-1])  # the proxy carries no stream
    with forging_proxy(server.url, request_, reply) as url:
        outcomes = {outcome.name: outcome.failure for outcome in conformance(url, None, "broken")}
    failure = outcomes[broken]
    assert failure is not None
    assert "expected" in failure
    assert "what is not there is named" in outcomes
    assert None in outcomes.values(), "some other checks pass"


def test_the_conformance_suite_leaves_an_existing_surrogate_alone(server: ServerProcess):
    from surrogym_sampler.diagnosis.conformance.target import SPEC

    with Api(server.url) as api:
        api.create_surrogate("taken", SPEC)
        result = run(server.url, "--surrogate", "taken")
        assert result.exit_code == 1
        assert api.surrogate("taken").name == "taken"
        api.delete_surrogate("taken")
