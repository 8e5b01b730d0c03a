"""What ``surrogym train`` says at its end: how the closed loop went, and after Ctrl-C how to go on with it."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from surrogym.cli import train
from surrogym_sampler.original.classic import pendulum
from surrogym_sampler.original.loading import env_option
from surrogym_trainer.training import TrainProgress, TrainResult, TrainSettings
from surrogym_trainer.training.handover import Handover
from surrogym_trainer.training.words import words_of, words_of_interruption, words_of_no_sampler, words_of_result

RESULT = TrainResult(Path("p.zip"), "PPO", 512, 1.0, -150.0, 0, {})


def test_a_training_without_rounds_says_nothing_of_them():
    assert words_of_result(RESULT) == (
        "p.zip: 512 virtual steps in 1.0 s, imagined return -150 (in the surrogate); next: surrogym evaluate p.zip"
    )


def test_a_server_that_was_given_is_given_to_the_evaluation_too():
    said = words_of_result(RESULT, server="http://other:8000")
    assert said.endswith("; next: surrogym evaluate p.zip --server http://other:8000")


def test_an_evaluation_of_ones_own_class_names_the_file_and_the_environment():
    said = words_of_result(replace(RESULT, path=Path("my tank.zip")), env_option=env_option("tank:Tank"))
    assert said.endswith("; next: surrogym evaluate 'my tank.zip' --env tank:Tank")


def test_fewer_steps_than_asked_for_are_explained():
    result = replace(RESULT, virtual_steps=24576, settings={"n_steps": 128, "num_envs": 64})
    assert "24576 virtual steps (30000 asked for; they are taken in rollouts of 8192) in" in words_of_result(
        result, asked=30_000
    )
    for asked in (None, 24_576, 90_000):  # the last one was stopped early, for another reason
        assert "asked for" not in words_of_result(result, asked=asked)


@pytest.mark.parametrize(
    ("name", "option"),
    [
        ("Pendulum-v1", ""),
        ("", " --env YOUR.MODULE:CLASS"),
        ("tank", " --env YOUR.MODULE:CLASS"),
        ("tank:Tank", " --env tank:Tank"),
        ("exec:rm -rf x", " --env exec:COMMAND"),
        ("a:b; ls", " --env 'a:b; ls'"),
    ],
)
def test_a_suggested_command_names_an_environment_that_is_not_known(name: str, option: str):
    assert env_option(name) == option


@pytest.mark.parametrize(("reason", "told"), [("no sampler is connected", True), ("the audit passed", False)])
def test_a_training_without_a_sampler_names_the_commands_of_an_audit(reason: str, told: bool):
    handover = Handover(None, None, False, reason)
    text = words_of_no_sampler(RESULT, handover, "surrogym sample tank --env tank:Tank")
    assert ("surrogym sample tank --env tank:Tank" in text and f"surrogym audit {RESULT.path}" in text) is told


def test_the_closed_loop_says_how_well_the_policys_region_is_known():
    assert "; the design was ready, so no round was needed; next" in words_of_result(RESULT, closed_loop=True)
    after = replace(RESULT, visited_confidence=(0.9, 0.99914))
    assert "; 2 rounds, confidence index 0.9991 where the policy went; next" in words_of_result(after, closed_loop=True)
    now = TrainProgress(100, 512, None, 0.0, visited_confidence=0.9)
    assert words_of(vars(now)) == "100 of about 512 virtual steps, confidence index 0.9000 where the policy went"


def test_the_progress_names_the_stage_of_a_search_that_has_some():
    now = TrainProgress(100, 512, -1.5, 0.0, stage="refine")
    assert words_of(vars(now)) == "refine: 100 of about 512 virtual steps, imagined return -1.5 (in the surrogate)"


def test_a_training_that_still_improves_shows_how_to_continue():
    words = words_of_result(replace(RESULT, gaining=True))
    assert "; it still improved at the end, and --start-from p.zip continues it; next: surrogym evaluate" in words


def test_replaced_networks_are_reported():
    assert "; 1 network replaced because of slow learning; next" in words_of_result(replace(RESULT, networks=2))
    assert "; 2 networks replaced because of slow learning; next" in words_of_result(replace(RESULT, networks=3))


def test_the_advice_after_an_interruption_keeps_the_closed_loop():
    words = words_of_interruption(RESULT, "cart --improve 5 --rounds 3")
    assert words.endswith("to continue: surrogym train cart --improve 5 --rounds 3 --start-from p.zip --out p.zip")


@pytest.mark.parametrize("sessions", [0, 1, 2])
def test_another_open_session_gives_a_warning_of_two_trainings(sessions: int, monkeypatch, capsys) -> None:
    known = {"name": "rig", "model_version": 1, "phase": "ready", "paused": False, "spec": pendulum()}
    view = SimpleNamespace(**known, sessions=sessions)
    monkeypatch.setattr(train, "awaited_surrogate", lambda *_, **__: view)
    monkeypatch.setattr(train, "connect", lambda *_, **__: nullcontext(SimpleNamespace(url="here")))
    assert train._trainable("rig", None, None, 0.0, TrainSettings(), quiet=False) == (pendulum(), "here")
    assert ("warning" in capsys.readouterr().err) is (sessions > 0)
