"""Policies over HTTP: what came is given out again, what does not fit changes nothing, nothing is ever loaded."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import sqlite3
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from support.controllers import network
from support.limited import SPEC
from support.server import ServerProcess
from surrogym_client.errors import InvalidInput, ServerFailure, SpecConflict, UnknownPolicy
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_server.features.policies import routes
from surrogym_shared import wire
from surrogym_shared.network import Network
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire.policies import AddDrift, PolicyFallback

PROMISE = wire.PolicyPromise(median=-150, low=-170, high=-130)


class Bomb:
    """Writes a file where somebody unpickles it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return open, (str(self.path), "w")


@pytest.mark.parametrize(
    ("example", "model"),
    [
        (routes.POLICY_EXAMPLE, wire.AddPolicy),
        (routes.EVALUATION_EXAMPLE, wire.AddEvaluation),
        (routes.ALIAS_EXAMPLE, wire.PutAlias),
        (routes.DRIFT_EXAMPLE, AddDrift),
    ],
)
def test_every_openapi_example_of_a_policy_passes_validation(example: dict[str, Any], model: type[wire.Request]):
    model.model_validate(example)


@pytest.fixture
def api(server_process: ServerProcess) -> Iterator[Api]:
    with Api(server_process.url) as opened:
        yield opened


@pytest.fixture
def surrogate(api: Api, name: str) -> Iterator[str]:
    api.create_surrogate(name, pendulum())
    yield name
    api.delete_surrogate(name)


def network_file(tmp_path: Path, seed: int = 0) -> bytes:
    """A policy of random arrays for Pendulum."""
    spec = pendulum()
    vector = np.random.default_rng(seed).normal(size=Network.size(spec, 4))
    Network.of(spec, np.zeros(3), np.ones(3), 4, vector).save(tmp_path / "policy.zip")
    return (tmp_path / "policy.zip").read_bytes()


def card(spec: EnvironmentSpec | None = None, **fields: Any) -> wire.PushedCard:
    return wire.PushedCard(algorithm="CMAES", spec=spec or pendulum(), promise=PROMISE, trusted=True, **fields)


def episodes(key: str = "a", **fields: Any) -> wire.AddEvaluation:
    given: dict[str, Any] = {"first_seed": 10_000, "returns": [-140.0, -160.0, -150.0], "lengths": [200] * 3}
    return wire.AddEvaluation(**{**given, "idempotency_key": key, **fields})


def test_an_uploaded_policy_is_returned_unchanged(api: Api, surrogate: str, tmp_path: Path):
    file = network_file(tmp_path)
    curve = [wire.CurvePoint(steps=10, imagined_return=-900.0, seconds=0.5)]
    pushed = api.policies.push(surrogate, card(settings={"units": 4}), curve, "zip", file)
    assert (pushed.version, pushed.created, pushed.promise, pushed.differs) == (1, True, PROMISE, None)
    assert [(one.form, one.bytes, one.stored) for one in pushed.files] == [("zip", len(file), True)]
    assert api.policies.file(surrogate, "latest", "zip") == file
    found = api.policies.get(surrogate, 1)
    assert (found.settings, found.curve) == ({"units": 4}, curve)
    again = api.policies.push(surrogate, card(settings={"units": 4}), curve, "zip", file)
    assert (again.version, again.created, again.pushed_by) == (1, False, "anybody")
    audited = api.policies.push(surrogate, card(reason="audited"), curve, "zip", file)
    assert (audited.version, audited.created, audited.reason) == (2, True, "audited")
    assert [one.stored for one in audited.files] == [True]
    assert api.policies.get(surrogate, 1) == found


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ('"settings": {"rate": [NaN]}', "card.settings.rate.0"),
        ('"settings": {"rate": 1e999}', "card.settings.rate"),
        ('"imagined_return": 1e308', "card.imagined_return"),
        ('"promise": {"median": 2, "low": 3, "high": 4}', "low <= median <= high"),
        ('"settings": {"a": "\\u0000"}', "NUL"),
        ('"settings": ' + 20 * '{"a":' + "1" + 20 * "}", "levels"),
    ],
)
def test_a_policy_description_with_invalid_values_is_refused(
    client: httpx.Client, surrogate: str, fields: str, named: str
):
    body = f'{{"card": {{{fields}}}, "file": {{"form": "zip", "bytes": 1, "digest": "{"0" * 64}"}}}}'
    reply = client.post(
        f"/v1/surrogates/{surrogate}/policies", content=body, headers={"content-type": "application/json"}
    )
    assert reply.status_code == 422
    assert named in reply.json()["detail"]
    assert client.get(f"/v1/surrogates/{surrogate}/policies").json()["policies"] == []


def test_the_audit_of_an_uploaded_policy_is_returned_unchanged(api: Api, surrogate: str, tmp_path: Path):
    """The server dropped how many steps were off the policy's way, and where this way leaves the sampling range."""
    left = wire.PolicyRangeLeft(coordinate="speed", side="upper", end=8.0, share=0.1, farthest=9.0)
    audit = wire.PolicyAudit(steps=8, elsewhere=2, passed=True, range_left=left)
    api.policies.push(surrogate, card(audit=audit), [], "zip", network_file(tmp_path))
    assert api.policies.get(surrogate, 1).audit == audit


def test_a_policy_with_the_largest_specification_and_a_learning_curve_is_stored(
    api: Api, surrogate: str, tmp_path: Path
):
    """A specification may have 128 KiB by itself."""
    curve = [wire.CurvePoint(steps=10**9 + n, imagined_return=-1 / 3, seconds=1 / 7) for n in range(200)]
    large = card(settings={"as large as a specification": "x" * 128 * 1024})
    assert api.policies.push(surrogate, large, curve, "zip", network_file(tmp_path)).created


def test_a_stored_evaluation_has_confidence_intervals_and_tells_if_the_promised_return_held(
    api: Api, surrogate: str, tmp_path: Path
):
    api.policies.push(surrogate, card(), [], "zip", network_file(tmp_path))
    trace = wire.EpisodeTrace(
        rank="worst", seed=10_001, coordinates=[[3.0, 0.0], [3.1, 0.2]], action=[[1.0]], reward=[-9.0]
    )
    success = [True, False, True]
    said = api.policies.evaluate(surrogate, 1, episodes(success=success, traces=[trace]))
    assert (said.mean, said.median, said.least, said.steps, said.promise_kept) == (-150, -150, -160, 600, None)
    assert said.mean_interval is not None
    assert -160 <= said.mean_interval.low < -150 < said.mean_interval.high <= -140
    assert said.success_interval is not None
    assert said.success_rate == pytest.approx(2 / 3)
    assert 0 < said.success_interval.low < 2 / 3 < said.success_interval.high < 1
    again = api.policies.evaluate(surrogate, 1, episodes(success=success, traces=[trace]))
    assert again == said  # the same key: once
    detail = api.policies.evaluation(surrogate, "latest", said.id)
    assert (detail.returns, detail.traces, detail.missing) == ([-140, -160, -150], [trace], None)
    short = api.connection.send("GET", f"/v1/surrogates/{surrogate}/policies/1/evaluations/{said.id}?traces=false")
    assert wire.EvaluationDetail.model_validate_json(short) == detail.model_copy(update={"traces": []})
    worse = api.policies.evaluate(surrogate, 1, episodes("b", returns=[-180.0] * 30, lengths=[200] * 30))
    kept = api.policies.evaluate(surrogate, 1, episodes("d", returns=[-150.0] * 30, lengths=[200] * 30))
    wide = api.policies.evaluate(surrogate, 1, episodes("c", returns=[-180.0] * 30, lengths=[200] * 30, declared=False))
    assert (worse.promise_kept, kept.promise_kept, wide.promise_kept) == (False, True, None)
    (policy,) = api.policies.list(surrogate)
    assert [one.id for one in policy.evaluations] == [said.id, worse.id, kept.id, wide.id]


def test_a_policy_whose_latest_evaluation_missed_its_promised_return_is_not_trusted(
    api: Api, surrogate: str, tmp_path: Path
):
    """Episodes elsewhere judge nothing, and a later evaluation that keeps the promise gives the trust back."""
    api.policies.push(surrogate, card(reason="an audit passed"), [], "zip", network_file(tmp_path))
    said = []
    for number, (mean, name) in enumerate([(-180.0, "plants:Heavy"), (-180.0, ""), (-150.0, "")]):
        returns: dict[str, Any] = {"returns": [mean] * 30, "lengths": [200] * 30}
        api.policies.evaluate(surrogate, 1, episodes(str(number), environment=name, **returns))
        said.append(api.policies.list(surrogate)[0])
    assert [one.trusted for one in said] == [True, False, True]
    assert said[1].reason == (
        "the latest evaluation broke the promise: a mean return of -180, where at least -170 was promised"
    )
    assert said[2].reason == "an audit passed"


def test_a_policy_whose_latest_evaluation_did_not_keep_its_limits_is_not_trusted(api: Api, name: str, tmp_path: Path):
    """Too many violations, or more fallbacks than promised. Other controllers judge nothing."""
    api.create_surrogate(name, SPEC)
    network(tmp_path, SPEC, (4,))
    fallback = PolicyFallback(median=0.0, mean=0.01, low=0.0, high=0.1)
    promised = card(SPEC, reason="an audit passed").model_copy(
        update={"promise": PROMISE.model_copy(update={"fallback": fallback})}
    )
    api.policies.push(name, promised, [], "zip", (tmp_path / "policy.zip").read_bytes())

    def judged(key: str, violations: int, fell_back: int, **fields: Any) -> wire.PolicyView:
        counts = wire.LimitCounts(violations=violations, fallbacks=2 * fell_back, fallback_episodes=fell_back)
        many: dict[str, Any] = {"returns": [-150.0] * 50, "lengths": [40] * 50, "limits": counts}
        api.policies.evaluate(name, 1, episodes(key, **many, **fields))
        return api.policies.list(name)[0]

    kept, left, late = judged("kept", 0, 1), judged("left", 4, 4), judged("late", 0, 20)
    other = judged("zero", 0, 50, controller="zero")
    again = judged("again", 1, 0)
    assert [one.trusted for one in (kept, left, late, other, again)] == [True, False, False, False, True]
    assert left.reason == (
        "the latest evaluation did not keep the limits: 4 of 50 episodes left a limit (95 % interval 2.2 to 19 %, "
        "allowed 1 %); the fallback acted in 8 of 2000 steps, in 4 of 50 episodes"
    )
    assert late.reason.endswith("the fallback acted more often than expected: in 0 to 10 % of the episodes")
    assert [one.limits and one.limits.violations for one in again.evaluations] == [0, 4, 0, 0, 1]
    with pytest.raises(ValueError, match="possible in 50 episodes with 2000 steps, got 51 violations"):
        judged("impossible", 51, 0)


def test_reported_drift_makes_a_policy_untrusted_until_an_evaluation_confirms_its_return(
    api: Api, client: httpx.Client, surrogate: str, tmp_path: Path
):
    api.policies.push(surrogate, card(reason="an audit passed"), [], "zip", network_file(tmp_path))
    many: dict[str, Any] = {"returns": [-150.0] * 30, "lengths": [200] * 30}
    api.policies.evaluate(surrogate, 1, episodes("before", **many))
    url, series = f"/v1/surrogates/{surrogate}/policies/1/drifts", f'{{surrogate="{surrogate}",version="1"}}'
    assert series not in client.get("/metrics").text
    first, again = (client.post(url, json=routes.DRIFT_EXAMPLE) for _ in range(2))
    assert first.status_code == 201
    assert first.json() == again.json()
    (policy,) = api.policies.list(surrogate)
    assert policy.trusted is False
    assert policy.reason.startswith("since ")
    assert policy.reason.endswith(f"drift: {routes.DRIFT_EXAMPLE['words']}")
    assert len(policy.evaluations) == 1
    assert policy.drifted_at is not None
    assert f"surrogym_policy_drift_time_seconds{series}" in client.get("/metrics").text
    broken = api.policies.evaluate(surrogate, 1, episodes("after", returns=[-180.0] * 30, lengths=[200] * 30))
    assert (broken.promise_kept, api.policies.get(surrogate, 1).trusted) == (False, False)
    api.policies.evaluate(surrogate, 1, episodes("later", **many))
    kept = api.policies.get(surrogate, 1)
    assert (kept.trusted, kept.reason, kept.drifted_at) == (True, "an audit passed", None)


@pytest.mark.parametrize(("field", "value"), [("error", float("inf")), ("words", "a\0b"), ("steps", -1), ("more", 1)])
def test_a_drift_report_with_invalid_values_is_refused_and_changes_nothing(
    api: Api, client: httpx.Client, surrogate: str, tmp_path: Path, field: str, value: object
):
    api.policies.push(surrogate, card(reason="an audit passed"), [], "zip", network_file(tmp_path))
    body = json.dumps({**routes.DRIFT_EXAMPLE, field: value})
    reply = client.post(
        f"/v1/surrogates/{surrogate}/policies/1/drifts", content=body, headers={"content-type": "application/json"}
    )
    assert reply.status_code == 422
    assert field in reply.json()["detail"]
    assert api.policies.get(surrogate, 1).trusted is True


def test_evaluations_in_another_environment_do_not_decide_whether_the_promised_return_held(
    api: Api, surrogate: str, tmp_path: Path
):
    api.policies.push(surrogate, card(), [], "zip", network_file(tmp_path))
    many: dict[str, Any] = {"returns": [-180.0] * 30, "lengths": [200] * 30}
    names = ("", "Pendulum-v1", "plants:Heavy")
    said = [api.policies.evaluate(surrogate, 1, episodes(name or "own", environment=name, **many)) for name in names]
    assert [(one.environment, one.own, one.promise_kept) for one in said] == [
        ("", True, False),
        ("Pendulum-v1", True, False),
        ("plants:Heavy", False, None),
    ]


def test_if_the_specification_names_no_environment_the_first_evaluation_defines_it(api: Api, name: str, tmp_path: Path):
    spec = pendulum().model_copy(update={"environment": "a pendulum"})
    api.create_surrogate(name, spec)
    try:
        api.policies.push(name, card(), [], "zip", network_file(tmp_path))
        names = ("plants:Own", "plants:Heavy", "plants:Own")
        said = [api.policies.evaluate(name, 1, episodes(str(i), environment=one)) for i, one in enumerate(names)]
        assert [one.own for one in said] == [True, False, True]
    finally:
        api.delete_surrogate(name)


def test_evaluations_of_fewer_than_30_episodes_do_not_decide_whether_the_promised_return_held(
    api: Api, surrogate: str, tmp_path: Path
):
    """Their mean is too uncertain. `surrogym evaluate` says so, and the server has to agree."""
    api.policies.push(surrogate, card(), [], "zip", network_file(tmp_path))
    few = api.policies.evaluate(surrogate, 1, episodes(returns=[-180.0] * 29, lengths=[200] * 29))
    assert few.promise_kept is None


def test_the_median_return_of_an_even_number_of_episodes_is_one_of_them(api: Api, surrogate: str, tmp_path: Path):
    api.policies.push(surrogate, card(), [], "zip", network_file(tmp_path))
    even = api.policies.evaluate(surrogate, 1, episodes(returns=[-1.0, -2.0, -4.0, -9.0], lengths=[200] * 4))
    assert even.median == -4.0


def test_a_policy_alias_can_be_moved_and_a_deleted_policy_is_unknown(api: Api, surrogate: str, tmp_path: Path):
    for seed in range(2):
        api.policies.push(surrogate, card(), [], "zip", network_file(tmp_path, seed))
    api.policies.put_alias(surrogate, "production", 1)
    assert api.policies.put_alias(surrogate, "production", 2).aliases == ["production"]
    assert api.policies.get(surrogate, "production").version == 2
    api.policies.drop_alias(surrogate, "production")
    with pytest.raises(UnknownPolicy, match="got production"):
        api.policies.get(surrogate, "production")
    api.policies.delete(surrogate, 2)
    with pytest.raises(UnknownPolicy):
        api.policies.file(surrogate, 2, "zip")
    with pytest.raises(InvalidInput):
        api.policies.put_alias(surrogate, "latest", 1)


def test_a_policy_for_another_specification_is_refused_with_the_difference(api: Api, surrogate: str, tmp_path: Path):
    with pytest.raises(SpecConflict, match="got one for another specification: observation is "):
        api.policies.push(surrogate, card(cartpole()), [], "zip", network_file(tmp_path))
    assert api.policies.list(surrogate) == []
    shorter = pendulum().model_copy(update={"time_limit": 100})
    assert api.policies.push(surrogate, card(shorter), [], "zip", network_file(tmp_path)).differs == "time_limit"


def test_a_policy_file_of_the_wrong_format_is_refused(api: Api, surrogate: str, tmp_path: Path):
    zipped = io.BytesIO()
    with zipfile.ZipFile(zipped, "w") as archive:
        archive.writestr("holiday.jpg", b"not a policy")
    for content in (b"PK\x03\x04 broken", zipped.getvalue(), b"#!/bin/sh"):
        with pytest.raises(InvalidInput, match=r"expected a zip of Stable-Baselines3.*got content"):
            api.policies.push(surrogate, card(), [], "zip", content)
    broken, *_ = api.policies.list(surrogate)
    assert [one.stored for one in broken.files] == [False]  # it says so, and the card is there
    version = api.policies.push(surrogate, card(), [], "zip", network_file(tmp_path)).version
    for form, content in (("mp4", b"<html>no video"), ("gif", b"GIF88a"), ("onnx", b"PK"), ("pt2", b"\x08\x01")):
        with pytest.raises(InvalidInput, match="got content that begins with"):
            api.policies.put_file(surrogate, version, form, content)
    api.policies.put_file(surrogate, version, "gif", b"GIF89a and so on")
    with pytest.raises(InvalidInput, match="was announced with, got a different file"):
        api.policies.put_file(surrogate, version, "zip", network_file(tmp_path, seed=1))
    with pytest.raises(UnknownPolicy, match=r"\(stored: zip, gif\), got 'onnx'"):
        api.policies.file(surrogate, version, "onnx")


def test_a_truncated_policy_file_upload_is_refused(api: Api, surrogate: str, tmp_path: Path):
    file = network_file(tmp_path)
    version = api.policies.push(surrogate, card(), [], "zip", file).version
    digest = {"digest": hashlib.sha256(file).hexdigest()}
    route = f"/v1/surrogates/{surrogate}/policies/{version}/files/zip"
    with pytest.raises(InvalidInput, match="expected a file with SHA-256"):
        api.connection.send("PUT", route, file[:-1], params=digest, media_type="application/octet-stream")
    assert api.policies.file(surrogate, version, "zip") == file


def test_the_server_never_unpickles_an_uploaded_policy_file(api: Api, surrogate: str, tmp_path: Path):
    exploded = tmp_path / "exploded"
    zipped = io.BytesIO()
    with zipfile.ZipFile(zipped, "w") as archive:
        for entry in ("data", "policy.pth", "data.pkl"):
            archive.writestr(entry, pickle.dumps(Bomb(exploded)))
    version = api.policies.push(surrogate, card(), [], "zip", zipped.getvalue()).version
    api.policies.put_file(surrogate, version, "pt2", zipped.getvalue())
    assert api.policies.file(surrogate, version, "pt2") == zipped.getvalue()
    api.policies.get(surrogate, version)
    assert not exploded.exists()


def test_an_evaluation_with_lists_of_unequal_length_is_refused(api: Api, surrogate: str, tmp_path: Path):
    api.policies.push(surrogate, card(), [], "zip", network_file(tmp_path))
    with pytest.raises(InvalidInput, match="lengths: expected 3 entries"):
        api.policies.evaluate(surrogate, 1, episodes(lengths=[200, 200]))
    for ragged in (
        {"coordinates": [[0.0, 0.0]], "action": [[1.0]]},
        {"coordinates": [[0.0, 0.0], [0.0]], "action": [[1.0]]},
        {"coordinates": [[0.0, 0.0, 0.0]] * 2, "action": [[1.0]]},
        {"coordinates": [[0.0, 0.0]] * 2, "action": [[1.0, 2.0]]},
    ):
        trace = wire.EpisodeTrace(rank="best", seed=1, reward=[0.0], **ragged)
        with pytest.raises(InvalidInput, match=r"traces.0: expected 2 states of 2 and 1 actions of 1 numbers"):
            api.policies.evaluate(surrogate, 1, episodes(traces=[trace]))
    assert api.policies.get(surrogate, 1).evaluations == []


def test_damaged_policy_files_are_reported_and_the_rest_stays_readable(
    api: Api, surrogate: str, tmp_path: Path, server_process: ServerProcess
):
    version = api.policies.push(surrogate, card(), [], "zip", network_file(tmp_path)).version
    said = api.policies.evaluate(surrogate, version, episodes())
    folder = Path(f"{server_process.folder}/surrogym.db.files")
    with sqlite3.connect(server_process.folder / "surrogym.db") as database:
        own = "SELECT blob FROM {} WHERE surrogate_id = (SELECT id FROM surrogates WHERE name = ?)"
        for table in ("policy_files", "policy_evaluations"):
            for (blob,) in database.execute(own.format(table), (surrogate,)):
                (folder / blob).write_bytes(b"something else")
    with pytest.raises(ServerFailure, match=r"the zip file of version 1 .* has changed since it was stored"):
        api.policies.file(surrogate, version, "zip")
    detail = api.policies.evaluation(surrogate, version, said.id)
    assert (detail.returns, detail.mean) == ([], said.mean)
    assert "has changed since it was stored" in (detail.missing or "")
    assert api.policies.get(surrogate, version).promise == PROMISE
