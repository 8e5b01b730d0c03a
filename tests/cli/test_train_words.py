"""What ``surrogym train`` says at its end: how the closed loop went, and after Ctrl-C how to go on with it."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from support.models import learn
from support.real_steps import random_steps
from surrogym.cli.commands import train
from surrogym.cli.errors import CommandError
from surrogym_sampler.original.classic import pendulum
from surrogym_sampler.original.loading import env_option
from surrogym_server.convert import definition_from_spec
from surrogym_server.local import LocalSurrogate
from surrogym_trainer.training import TrainProgress, TrainResult, TrainSettings
from surrogym_trainer.training import train as run
from surrogym_trainer.training.handover import Handover
from surrogym_trainer.training.words import words_of, words_of_interruption, words_of_no_sampler, words_of_result

RESULT = TrainResult(Path("p.zip"), "PPO", 512, 1.0, -150.0, 0, {})


def test_the_result_of_a_training_without_rounds_does_not_mention_rounds():
    assert words_of_result(RESULT) == (
        "p.zip: 512 virtual steps in 1.0 s, imagined return -150 (in the surrogate); next: surrogym evaluate p.zip"
    )


def test_the_recommended_evaluation_repeats_a_given_server():
    said = words_of_result(RESULT, server="http://other:8000")
    assert said.endswith("; next: surrogym evaluate p.zip --server http://other:8000")


def test_the_recommended_evaluation_of_a_user_defined_environment_class_contains_env():
    said = words_of_result(replace(RESULT, path=Path("my tank.zip")), env_option=env_option("tank:Tank"))
    assert said.endswith("; next: surrogym evaluate 'my tank.zip' --env tank:Tank")


def test_a_training_explains_why_it_took_fewer_real_steps_than_requested():
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
def test_a_recommended_command_contains_env_for_unregistered_environments(name: str, option: str):
    assert env_option(name) == option


@pytest.mark.parametrize(("reason", "told"), [("no sampler is connected", True), ("the audit passed", False)])
def test_a_training_without_a_sampler_recommends_sample_and_audit(reason: str, told: bool):
    handover = Handover(None, None, False, reason)
    text = words_of_no_sampler(RESULT, handover, "surrogym sample tank --env tank:Tank")
    assert ("surrogym sample tank --env tank:Tank" in text and f"surrogym audit {RESULT.path}" in text) is told


def test_a_closed_loop_training_reports_the_confidence_over_visited_states():
    assert "; the design was ready, so no round was needed; next" in words_of_result(RESULT, closed_loop=True)
    after = replace(RESULT, visited_confidence=(0.9, 0.99914))
    assert "; 2 rounds, confidence index 0.9991 where the policy went; next" in words_of_result(after, closed_loop=True)
    now = TrainProgress(100, 512, None, 0.0, visited_confidence=0.9)
    assert words_of(vars(now)) == "100 of about 512 virtual steps, confidence index 0.9000 where the policy went"


def test_the_training_progress_names_the_stage_of_a_policy_search():
    now = TrainProgress(100, 512, -1.5, 0.0, stage="refine")
    assert words_of(vars(now)) == "refine: 100 of about 512 virtual steps, imagined return -1.5 (in the surrogate)"


def test_a_planner_says_what_it_computes_and_counts_no_virtual_steps(tmp_path):
    spec = pendulum().model_copy(update={"time_limit": 20})
    port = LocalSurrogate(spec, learn(definition_from_spec(spec), random_steps(spec, 8, seed=0)).model)
    seen: list[TrainProgress] = []
    result = run(port, tmp_path / "p.zip", TrainSettings("PLANNER", hyperparameters={"horizon": 3}), seen.append)
    first, last = (words_of(vars(now)) for now in seen)
    assert first == "computes values on a grid; the first process on a machine compiles for a minute"
    assert last == f"computed values on a grid, imagined return {result.imagined_return:.4g} (in the surrogate)"
    assert f"{tmp_path / 'p.zip'}: made without training in " in words_of_result(result)


def test_a_training_that_still_improves_shows_how_to_continue():
    words = words_of_result(replace(RESULT, gaining=True))
    assert "; it still improved at the end, and --start-from p.zip continues it; next: surrogym evaluate" in words


def test_the_training_result_reports_networks_that_were_replaced_because_they_did_not_learn():
    assert "; 1 network replaced because of slow learning; next" in words_of_result(replace(RESULT, networks=2))
    assert "; 2 networks replaced because of slow learning; next" in words_of_result(replace(RESULT, networks=3))


def test_a_training_that_learned_slowly_names_the_planner_where_one_fits():
    said = words_of_result(replace(RESULT, networks=2), fits_planner=True)
    assert (
        "; 1 network replaced because of slow learning (--algorithm planner plans with the model instead); next" in said
    )
    assert "planner" not in words_of_result(RESULT, fits_planner=True)


def test_the_command_recommended_after_an_interrupted_training_repeats_its_improve_and_rounds_options():
    words = words_of_interruption(RESULT, "cart --improve 5 --rounds 3")
    assert words.endswith("to continue: surrogym train cart --improve 5 --rounds 3 --start-from p.zip --out p.zip")


def test_the_command_recommended_after_an_interrupted_planner_makes_it_again():
    planner = replace(RESULT, algorithm="PLANNER", virtual_steps=0)
    words = words_of_interruption(planner, "cart --algorithm planner")
    assert words.endswith("not audited; to make it again: surrogym train cart --algorithm planner --out p.zip")


@pytest.mark.parametrize("sessions", [0, 1, 2])
def test_the_train_command_warns_if_another_session_of_the_surrogate_is_open(
    sessions: int, monkeypatch, capsys
) -> None:
    known = {"name": "rig", "model_version": 1, "phase": "ready", "paused": False, "spec": pendulum()}
    view = SimpleNamespace(**known, sessions=sessions)
    monkeypatch.setattr(train, "awaited_surrogate", lambda *_, **__: view)
    monkeypatch.setattr(train, "connect", lambda *_, **__: nullcontext(SimpleNamespace(url="here")))
    assert train._trainable("rig", None, None, 0.0, TrainSettings(), quiet=False) == (pendulum(), "here")
    assert ("warning" in capsys.readouterr().err) is (sessions > 0)


def test_a_limit_that_can_not_be_kept_is_refused_before_the_design_is_awaited(monkeypatch) -> None:
    view = SimpleNamespace(name="rig", spec=pendulum())
    monkeypatch.setattr(train, "awaited_surrogate", lambda *_, **__: view)
    monkeypatch.setattr(train, "connect", lambda *_, **__: nullcontext(SimpleNamespace(url="here")))
    settings = TrainSettings(algorithm="PLANNER", hyperparameters={"limits": ["speed<=99"]})
    with pytest.raises(CommandError, match=r"limit 'speed<=99': expected a number between -8 and 8"):
        train._trainable("rig", None, None, 60.0, settings, quiet=True)


def test_a_training_says_why_its_policies_try_no_episodes():
    spec = SimpleNamespace(needs_trials=True, preset=SimpleNamespace(search="FASTPPO"), action=pendulum().action)
    view = SimpleNamespace(name="rail", environment="plant:Rail", budget_left=70, samplers=0, spec=spec)
    assert train._words_without_trials(view, TrainSettings(algorithm="FASTPPO")) == (
        "no sampler is running, so no trials take the other 70 real steps of the budget: for trials, start surrogym "
        "sample rail --env plant:Rail in another terminal first"
    )
    view.samplers = 1
    assert train._words_without_trials(view, TrainSettings(algorithm="CMAES")) == ""
    assert train._words_without_trials(view, TrainSettings(algorithm="sac")) == (
        "samplers can't run policies of SAC, so no trials take the other 70 real steps of the budget: for trials, "
        "train without --algorithm"
    )
    assert train._words_without_trials(view, TrainSettings(algorithm="FASTPPO", integral=("x",))) == ""


@pytest.mark.parametrize(("needs", "policy", "told"), [(True, False, True), (True, True, False), (False, False, False)])
def test_a_training_before_the_end_of_the_design_says_that_it_takes_no_trials(needs: bool, policy: bool, told: bool):
    spec = SimpleNamespace(needs_trials=needs)
    view = SimpleNamespace(name="rail", phase="fitting", budget_left=70, samplers=1, spec=spec)
    queries = [SimpleNamespace(purpose="adaptive", policy=policy)]
    api = SimpleNamespace(surrogate=lambda _: view, queries=lambda _: queries)
    assert ("takes no trials" in train._words_of_too_early(api, view)) is told
