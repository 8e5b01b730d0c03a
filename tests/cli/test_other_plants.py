"""``surrogym evaluate --env`` in another environment than the policy's own: its promise says nothing about that one."""

from __future__ import annotations

import json
from contextlib import contextmanager

import numpy as np
import pytest

from support.machine import SettableMachine, diary_in
from surrogym_client.transport import Api
from surrogym_server.features.policies.routes import DRIFT_EXAMPLE
from surrogym_shared.archives import stored
from surrogym_shared.network import Network
from surrogym_trainer.policies import PolicyCard
from surrogym_trainer.policies.evidence import Audit, Promise, RangeLeft
from surrogym_trainer.policies.pushing import push
from surrogym_trainer.training.handover import Handover

OWN, OTHER = "support.machine:SettableMachine", "support.moody:Line"
EVALUATE = ("evaluate", "policy.zip", "--episodes", "30", "--no-push", "--server", "http://127.0.0.1:9")


@pytest.fixture(params=[-1e6, 1e6], ids=["promised less", "promised more"])
def promised(request, tmp_path, monkeypatch):
    """A policy whose promise is far from what any plant gives."""
    promise = Promise(median=request.param, low=request.param - 1, high=request.param + 1, functions=1, episodes=1)
    spec = SettableMachine.spec(None).model_copy(update={"environment": OWN})
    (tmp_path / "policy.zip").write_bytes(stored({}))
    (tmp_path / "policy.json").write_text(PolicyCard(spec=spec, promise=promise).model_dump_json())
    monkeypatch.setattr("surrogym_trainer.policies.files.load_policy", lambda *_, **__: lambda o: np.ones((len(o), 1)))
    with diary_in(tmp_path, monkeypatch):
        yield promise


def test_returns_in_another_environment_are_not_compared_with_the_promised_return(surrogym, promised):
    said = surrogym(*EVALUATE, "--env", OTHER)
    assert said.code == 0, said.err
    assert "kept" not in said.out
    assert "broken" not in said.out
    assert f"{promised.low:.4g} to {promised.high:.4g}" in said.out
    assert f"is for {OWN}" in said.out
    assert json.loads(surrogym(*EVALUATE, "--env", OTHER, "--json").out)["promise_kept"] is None


def test_returns_in_the_policys_own_environment_are_compared_with_the_promised_return(surrogym, promised):
    said = surrogym(*EVALUATE, "--env", OWN)
    assert said.code == 0, said.err
    assert ("kept" in said.out) == (promised.median < 0)
    assert ("broken" in said.out) == (promised.median > 0)


@contextmanager
def registered(url, folder, name, environment):
    """A surrogate whose policy is that of ``promised``, and whose specification is of ``environment``."""
    card = PolicyCard.model_validate_json((folder / "policy.json").read_text())
    assert card.spec is not None
    spec = card.spec.model_copy(update={"environment": environment})
    size = Network.size(spec, 4)
    Network.of(spec, np.zeros(1), np.ones(1), 4, np.zeros(size)).save(folder / "policy.zip")
    own = card.model_copy(update={"spec": spec, "surrogate": name, "algorithm": "CMAES", "untrained": -10.0})
    (folder / "policy.json").write_text(own.model_dump_json())
    with Api(url) as api:
        api.create_surrogate(name, spec)
        yield name
        api.delete_surrogate(name)


@pytest.fixture
def of_a_log(promised, server_process, tmp_path, name):
    """The name of a surrogate whose specification names no environment, as that of a log."""
    with registered(server_process.url, tmp_path, name, name):
        yield name


def test_a_promise_from_a_log_is_not_judged_in_another_than_the_first_environment(surrogym, server_process, of_a_log):
    evaluate = ("evaluate", "policy.zip", "--episodes", "30", "--server", server_process.url)
    first = surrogym(*evaluate, "--env", OWN)
    assert "kept" in first.out or "broken" in first.out, first.err
    other = surrogym(*evaluate, "--env", OTHER)
    assert other.code == 0, other.err
    assert "kept" not in other.out
    assert "broken" not in other.out
    assert "is for the environment of the surrogate's first evaluation" in other.out
    assert json.loads(surrogym(*evaluate, "--env", OTHER, "--json").out)["promise_kept"] is None


@pytest.mark.parametrize("promised", [-1e6], indirect=True)
def test_a_policy_downloaded_after_a_drift_earns_back_the_trust_of_its_version(
    surrogym, server_process, promised, tmp_path, name
):
    """Its episodes were stored with a new version, because the downloaded card says that it is not trusted."""
    at_server = ("--server", server_process.url)
    left = RangeLeft(coordinate="q", side="upper", end=1.0, share=0.1, farthest=2.0)
    audit = Audit(steps=60, passed=True, before=promised, after=promised, range_left=left)
    with registered(server_process.url, tmp_path, name, OWN), Api(server_process.url) as api:
        card = PolicyCard.model_validate_json((tmp_path / "policy.json").read_text())
        judged = {"trusted": True, "reason": "an audit passed", "audit": audit, "networks": 2}
        (tmp_path / "policy.json").write_text(card.model_copy(update=judged).model_dump_json())
        push(api, tmp_path / "policy.zip")
        api.connection.send("POST", f"/v1/surrogates/{name}/policies/1/drifts", json.dumps(DRIFT_EXAMPLE).encode())
        assert surrogym("policy", "get", f"{name}@1", "--out", "got.zip", *at_server).code == 0
        assert json.loads((tmp_path / "got.json").read_text())["trusted"] is False
        said = surrogym("evaluate", "got.zip", "--env", OWN, "--episodes", "30", "--json", *at_server)
        assert (said.code, said.json["version"]) == (0, 1), said.err
        (policy,) = api.policies.list(name)
        assert (policy.trusted, policy.reason, policy.drifted_at) == (True, "an audit passed", None)


def test_an_audit_in_another_environment_does_not_make_a_policy_trusted(
    surrogym, server_process, promised, tmp_path, name, monkeypatch
):
    """It was written into the card without the name of the environment."""
    audit = Audit(steps=60, passed=True, before=promised, after=promised)
    agreed = Handover(promised, audit, True, "the episodes agree")
    monkeypatch.setattr("surrogym.cli.commands.audit.by_episodes", lambda *_, **__: agreed)
    command = ("audit", "policy.zip", "--server", server_process.url)
    with registered(server_process.url, tmp_path, name, OWN):
        before = (tmp_path / "policy.json").read_text()
        elsewhere = surrogym(*command, "--env", OTHER)
        assert elsewhere.code == 0, elsewhere.err
        assert f"ran in {OTHER}, and the policy is for {OWN}: its card is unchanged" in elsewhere.out
        assert (tmp_path / "policy.json").read_text() == before
        with Api(server_process.url) as api:
            assert api.policies.list(name) == []
        surrogym(*command, "--env", OWN)
        assert json.loads((tmp_path / "policy.json").read_text())["trusted"] is True
