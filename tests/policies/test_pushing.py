"""Policies reach the server, or wait beside their file: nothing is lost and nothing is sent twice."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from support.server import ServerProcess
from surrogym_client.errors import ServerUnreachable, SpecConflict
from surrogym_client.transport import Api, Retries
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_shared import wire
from surrogym_shared.network import Network
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.policies import pushing
from surrogym_trainer.policies.card import NotedAddress, PolicyCard, UnusablePolicy, write_card

NAME = "pushed"


@pytest.fixture
def api(server_process: ServerProcess) -> Iterator[Api]:
    with Api(server_process.url) as opened:
        opened.create_surrogate(NAME, pendulum())
        yield opened
        opened.delete_surrogate(NAME)


def test_pushing_a_policy_sends_its_video_once_and_reports_a_broken_one(api: Api, policy: Path):
    video = policy.with_suffix(".mp4")
    video.write_bytes(b"\0\0\0\x20ftypisom" + bytes(500))
    assert pushing.push(api, policy).refused == ""
    assert api.policies.file(NAME, 1, "mp4") == video.read_bytes()
    assert pushing.push(api, policy).refused == ""
    assert [one.form for one in api.policies.get(NAME, 1).files] == ["zip", "mp4"]
    video.write_bytes(b"no video")
    again = pushing.push(api, policy)
    assert "expected an MP4 video" in again.refused
    assert api.policies.file(NAME, 1, "mp4") != b"no video"


@pytest.fixture
def away() -> Api:
    return Api("http://127.0.0.1:9", retries=Retries(seconds=0))


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    return written(tmp_path / "policy.zip", pendulum())


def written(path: Path, spec: EnvironmentSpec) -> Path:
    vector = np.zeros(Network.size(spec, 4))
    size = len(spec.observation)
    Network.of(spec, np.zeros(size), np.ones(size), 4, vector).save(path)
    curve = tuple(wire.CurvePoint(steps=n) for n in range(3))
    noted = NotedAddress("http://secret.example")
    write_card(path, PolicyCard(algorithm="CMAES", surrogate=NAME, server=noted, spec=spec, curve=curve))
    return path


def evaluation(key: str) -> wire.AddEvaluation:
    return wire.AddEvaluation(first_seed=1, returns=[-1.0, -2.0], lengths=[3, 4], idempotency_key=key)


def test_evaluations_are_sent_later_if_the_server_is_unreachable(api: Api, away: Api, policy: Path):
    pushing.keep(policy, evaluation("a"))
    pushing.keep(policy, evaluation("b"))
    with pytest.raises(ServerUnreachable):
        pushing.push(away, policy)
    assert len(json.loads(pushing.waiting_path(policy).read_text())) == 2
    sent = pushing.push(api, policy)
    assert (sent.surrogate, sent.policy.version, sent.policy.created, sent.evaluations) == (NAME, 1, True, 2)
    assert not pushing.waiting_path(policy).exists()
    again = pushing.push(api, policy)
    assert (again.policy.version, again.policy.created, again.evaluations) == (1, False, 0)
    found = api.policies.get(NAME)
    assert [one.mean for one in found.evaluations] == [-1.5, -1.5]
    assert [point.steps for point in found.curve] == [0, 1, 2]
    assert api.policies.file(NAME, 1, "zip") == policy.read_bytes()


def test_an_evaluation_stored_during_a_push_is_kept_for_the_next_push(
    api: Api, policy: Path, monkeypatch: pytest.MonkeyPatch
):
    pushing.keep(policy, evaluation("a"))
    send = type(api.policies).evaluate

    def sent_while_another_is_kept(calls: object, *arguments: object) -> object:
        pushing.keep(policy, evaluation("b"))
        return send(calls, *arguments)

    monkeypatch.setattr(type(api.policies), "evaluate", sent_while_another_is_kept)
    assert pushing.push(api, policy).evaluations == 1
    assert [one["idempotency_key"] for one in json.loads(pushing.waiting_path(policy).read_text())] == ["b"]


def test_pushing_a_policy_does_not_send_the_server_address_of_its_description(api: Api, policy: Path):
    pushing.push(api, policy)
    assert "secret" not in api.policies.get(NAME).model_dump_json()


def test_a_refused_push_keeps_the_policys_unsent_evaluations(api: Api, tmp_path: Path):
    other = written(tmp_path / "other.zip", cartpole())
    pushing.keep(other, evaluation("a"))
    with pytest.raises(SpecConflict):
        pushing.push(api, other)
    assert pushing.waiting_path(other).exists()
    assert api.policies.list(NAME) == []


@pytest.mark.parametrize("content", ["", "[{}]", '{"returns": 1}', "[" * 1000])
def test_a_damaged_file_of_unsent_evaluations_is_reported_and_kept(api: Api, policy: Path, content: str):
    pushing.waiting_path(policy).write_text(content)
    with pytest.raises(UnusablePolicy, match=r"policy\.evaluations\.json is not a list of evaluations"):
        pushing.push(api, policy)
    assert pushing.waiting_path(policy).read_text() == content


def test_pushing_a_policy_without_surrogate_or_of_unknown_format_is_refused(away: Api, tmp_path: Path):
    plain = tmp_path / "plain.zip"
    plain.write_bytes(b"x")
    with pytest.raises(UnusablePolicy, match="no card beside"):
        pushing.push(away, plain)
    odd = tmp_path / "policy.pkl"
    odd.write_bytes(b"x")
    with pytest.raises(UnusablePolicy, match=r"expected a file ending in zip, .*got policy\.pkl"):
        pushing.push(away, odd)


@pytest.mark.parametrize(
    ("fields", "named"), [({"reason": "r" * 2_001}, "reason"), ({"versions": {"torch": "2\n"}}, "versions.torch")]
)
def test_pushing_an_invalid_policy_description_names_the_invalid_field(
    away: Api, policy: Path, fields: dict[str, object], named: str
):
    write_card(policy, PolicyCard(surrogate=NAME, **fields))
    with pytest.raises(UnusablePolicy, match=f"the card beside .* can't be stored: {named}"):
        pushing.push(away, policy)


def test_pushing_a_policy_sends_a_long_learning_curve_thinned(api: Api, policy: Path):
    curve = tuple(wire.CurvePoint(steps=n) for n in range(501))
    write_card(policy, PolicyCard(surrogate=NAME, curve=curve))
    pushing.push(api, policy)
    assert api.policies.get(NAME).curve[-1].steps == 500


@pytest.mark.parametrize("count", [0, 1, 199, 200, 201, 999])
def test_a_thinned_learning_curve_keeps_its_last_point(count: int):
    curve = [wire.CurvePoint(steps=n) for n in range(count)]
    thin = pushing.thinned(curve)
    assert len(thin) <= pushing.CURVE_POINTS
    assert [point.steps for point in thin[-1:]] == [point.steps for point in curve[-1:]]
    assert thin == tuple(sorted(thin, key=lambda point: point.steps))
