"""``surrogym evaluate --learn`` and ``--learn-all``: no real step is taken for nothing, and none is lost."""

from __future__ import annotations

import numpy as np
import pytest

from support.machine import Machine, diary_in
from surrogym_client.cli.disagreement import Differences
from surrogym_client.cli.errors import CommandError
from surrogym_client.evaluation.evaluator import EvaluationSettings
from surrogym_client.policies import PolicyCard
from surrogym_client.transport import Api
from surrogym_shared.archives import stored

MACHINE = ("--env", "support.machine:Machine")


@pytest.fixture
def policy(tmp_path, monkeypatch, name):
    """A policy for the machine that always pushes, as trained for the surrogate ``name``."""
    (tmp_path / "policy.zip").write_bytes(stored({}))
    (tmp_path / "policy.json").write_text(PolicyCard(spec=Machine.spec(None), surrogate=name).model_dump_json())
    monkeypatch.setattr("surrogym_client.policies.files.load_policy", lambda *_, **__: lambda o: np.ones((len(o), 1)))
    return "policy.zip"


@pytest.fixture
def diary(tmp_path, monkeypatch):
    with diary_in(tmp_path, monkeypatch) as file:
        yield file


def test_a_wait_for_no_model_is_refused():
    """It was ignored, and a person took the model of before for the one that had learned."""
    with pytest.raises(CommandError, match="expected --wait with --learn or --learn-all, got neither"):
        Differences(wait=5.0).check(EvaluationSettings())
    Differences(wait=5.0, learn_all=True).check(EvaluationSettings())
    Differences(wait=5.0, learn=3).check(EvaluationSettings())


@pytest.mark.parametrize("option", [("--learn-all",), ("--learn", "3")])
def test_an_unknown_surrogate_is_refused_before_the_first_real_step(on_server, policy, diary, option):
    """All real steps were taken, went nowhere, and the exit status was 0."""
    said = on_server("evaluate", policy, *MACHINE, *option, "--surrogate", "nosuch")
    assert (said.code, "'nosuch'" in said.err) == (1, True), said.err
    assert "step" not in diary.read_text()
    assert "reset" not in diary.read_text()


def test_a_server_that_does_not_answer_is_told_before_the_first_real_step(surrogym, policy, diary):
    """Without --learn-all, it does not stop an evaluation."""
    nowhere = ("--server", "http://127.0.0.1:9")
    said = surrogym("evaluate", policy, *MACHINE, *nowhere, "--learn-all")
    assert (said.code, "surrogym serve" in said.err) == (1, True), said.err
    assert "step" not in diary.read_text()
    assert surrogym("evaluate", policy, *MACHINE, *nowhere, "--episodes", "1").code == 0
    assert "step" in diary.read_text()


def test_a_policy_of_no_surrogate_has_none_that_learns(surrogym, policy, diary, tmp_path):
    (tmp_path / "policy.json").write_text(PolicyCard(spec=Machine.spec(None)).model_dump_json())
    said = surrogym("evaluate", policy, *MACHINE, "--learn-all")
    assert (said.code, "expected --surrogate with --learn-all, got none" in said.err) == (1, True), said.err
    assert "step" not in diary.read_text()


def test_a_surrogate_of_another_system_is_refused_before_the_first_real_step(on_server, policy, diary, name):
    """All real steps were taken, and not added: their coordinates were others."""
    assert on_server("register", "Pendulum-v1", "--name", name).code == 0
    said = on_server("evaluate", policy, *MACHINE, "--learn-all")
    assert (said.code, "can't learn from these steps: expected coordinates (theta, " in said.err) == (1, True), said.err
    assert set(diary.read_text().split()) == {"open", "close"}


def test_a_surrogate_without_a_model_has_no_differing_steps(on_server, server_process, policy, diary, name):
    """--learn was ignored without a word."""
    with Api(server_process.url) as api:
        api.create_surrogate(name, Machine.spec(None))
    said = on_server("evaluate", policy, *MACHINE, "--learn", "3")
    assert (said.code, "has no model yet: --learn-all adds every step" in said.err) == (1, True), said.err
    assert "step" not in diary.read_text()
