"""A policy of another environment moves no machine, and one sentence says what it is for."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from support.machine import Machine, diary_in
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_shared.archives import stored
from surrogym_shared.spec import BoxAction, EnvironmentSpec
from surrogym_trainer.policies.card import PolicyCard

MACHINE = ("--env", "support.machine:Machine", "--episodes", "2")


@pytest.fixture
def policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Writes ``policy.zip``, or another file, with a card of this specification. The policy pushes with all its force,
    whatever it observes."""
    monkeypatch.setattr("surrogym_trainer.policies.files.load_policy", lambda *_, **__: lambda o: np.ones((len(o), 1)))

    def write(spec: EnvironmentSpec | None, name: str = "policy") -> None:
        (tmp_path / f"{name}.zip").write_bytes(stored({}))
        (tmp_path / f"{name}.json").write_text(PolicyCard(spec=spec).model_dump_json())

    return write


@pytest.fixture
def diary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with diary_in(tmp_path, monkeypatch) as diary:
        yield diary


def test_evaluating_a_policy_of_another_environment_is_refused_before_any_step(surrogym, policy, diary) -> None:
    """Saturated actions went to the plant, and the result was stored under the policy."""
    policy(pendulum())
    said = surrogym("evaluate", "policy.zip", *MACHINE)
    assert said.code == 1
    assert said.err == (
        "error: the policy does not fit the environment, it is for Pendulum-v1: expected coordinates (theta, speed) "
        "and a box action of 1, got coordinates (x) and a box action of 1\n"
    )
    assert diary.read_text().splitlines() == ["open", "close"]


def test_evaluating_a_policy_with_larger_action_bounds_is_refused_before_any_step(surrogym, policy, diary) -> None:
    policy(Machine.spec(None).model_copy(update={"action": BoxAction(low=(-5.0,), high=(5.0,))}))
    said = surrogym("evaluate", "policy.zip", *MACHINE)
    assert "it is for a rail: expected actions from [-5] to [5], got [-1] to [1]\n" in said.err
    assert diary.read_text().splitlines() == ["open", "close"]


def test_a_reference_policy_of_another_environment_is_refused(surrogym, policy, diary) -> None:
    policy(Machine.spec(None))
    policy(pendulum(), "reference")
    said = surrogym("evaluate", "policy.zip", *MACHINE, "--reference", "reference.zip")
    assert "the policy does not fit the environment, it is for Pendulum-v1" in said.err
    assert said.code == 1
    assert diary.read_text().splitlines() == ["open", "close"]


@pytest.mark.parametrize("card", [None, Machine.spec(None)], ids=["no card", "its own card"])
def test_a_policy_that_fits_the_environment_and_one_without_description_are_evaluated(
    surrogym, policy, diary, card
) -> None:
    policy(card)
    said = surrogym("evaluate", "policy.zip", *MACHINE)
    assert said.code == 0, said.err
    assert {"reset 10000", "reset 10001"} < set(diary.read_text().splitlines())


def test_a_policy_that_does_not_fit_the_given_specification_opens_no_environment(
    surrogym, policy, diary, tmp_path
) -> None:
    policy(pendulum())
    (tmp_path / "rail.json").write_text(Machine.spec(None).model_dump_json())
    said = surrogym("evaluate", "policy.zip", *MACHINE, "--spec", "rail.json")
    assert "expected coordinates (theta, speed) and a box action of 1, got coordinates (x)" in said.err
    assert diary.read_text() == ""


@pytest.mark.parametrize("given", [(), ("--spec", "other.json")], ids=["by its name", "with a specification"])
def test_evaluating_a_policy_on_another_task_of_the_same_library_is_refused(surrogym, policy, tmp_path, given) -> None:
    """It asked for a specification, and with one it ended in NumPy's words about operands."""
    pytest.importorskip("dm_control")
    policy(pendulum().model_copy(update={"environment": "dm_control:pendulum-swingup"}))
    other = cartpole().model_copy(update={"environment": "dm_control:cartpole-swingup"})
    (tmp_path / "other.json").write_text(other.model_dump_json())
    said = surrogym("evaluate", "policy.zip", "--env", "dm_control:cartpole-swingup", *given)
    assert said.code == 1
    assert re.match(
        r"error: the policy (is|does not fit the environment, it is) for dm_control:pendulum-swingup", said.err
    )
    assert "coordinates (theta, speed) and a box action of 1" in said.err


def test_a_training_refuses_to_start_from_a_policy_of_another_environment(on_server, policy, name, monkeypatch) -> None:
    """It failed after 17 s, with the shapes of arrays."""
    policy(pendulum())
    trainable = (Machine.spec(None), "http://127.0.0.1:9")
    monkeypatch.setattr("surrogym.cli.commands.train._trainable", lambda *_, **__: trainable)
    said = on_server("train", name, "--start-from", "policy.zip", "--out", "next.zip")
    assert (said.code, said.out) == (1, "")
    assert said.err == (
        "error: the policy does not fit the surrogate, it is for Pendulum-v1: expected coordinates (theta, speed) and "
        "a box action of 1, got coordinates (x) and a box action of 1\n"
    )


def test_a_training_that_would_replace_a_specification_is_refused_before_it_waits(surrogym, tmp_path) -> None:
    (tmp_path / "tank.json").write_text('{"coordinates": []}')
    said = surrogym("train", "tank", "--wait", "60", "--out", "tank.zip", "--server", "http://127.0.0.1:9")
    assert said.code == 1
    assert "the card of tank.zip would replace tank.json, which is not a card: choose another name" in said.err
