"""``surrogym evaluate --env`` in another environment than the policy's own: its promise says nothing about that one."""

from __future__ import annotations

import json

import numpy as np
import pytest

from support.machine import SettableMachine, diary_in
from surrogym_shared.archives import stored
from surrogym_trainer.policies import PolicyCard
from surrogym_trainer.policies.evidence import Promise

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
