"""The choice of a policy search where a training names none."""

from pathlib import Path

import pytest

from surrogym_sampler.original.classic import pendulum
from surrogym_shared.spec import Design
from surrogym_trainer.training import TrainSettings
from surrogym_trainer.training.search import search_for, with_algorithm

PAPER = pendulum().model_copy(update={"design": Design(preset="paper", budget=40)})


@pytest.mark.parametrize(
    ("chosen", "spec", "name"),
    [
        ({}, pendulum(), "FASTPPO"),
        ({"hyperparameters": {"n_epochs": 3}}, pendulum(), "FASTPPO"),
        ({"hyperparameters": {"ent_coef": 0.01}}, pendulum(), "PPO"),
        ({"tracker": "tensorboard"}, pendulum(), "PPO"),
        ({}, PAPER, "PPO"),
        ({"algorithm": "sac", "tracker": "mlflow"}, PAPER, "sac"),
    ],
    ids=["nothing", "its hyperparameter", "another's hyperparameter", "tracker", "paper", "named"],
)
def test_fastppo_is_the_default_policy_search_unless_settings_need_stable_baselines3(chosen: dict, spec, name: str):
    assert with_algorithm(TrainSettings(**chosen), spec).algorithm == name


def test_continuing_a_stable_baselines3_policy_selects_stable_baselines3_ppo(tmp_path: Path):
    start = tmp_path / "policy.zip"
    start.write_bytes(b"no network of arrays")
    assert with_algorithm(TrainSettings(start_from=start), pendulum()).algorithm == "PPO"


def test_a_tracker_is_refused_by_a_policy_search_that_does_not_log():
    with pytest.raises(ValueError, match="FASTPPO reports to no tracker: leave mlflow out"):
        search_for(TrainSettings("fastppo", tracker="mlflow"))


@pytest.mark.parametrize("chosen", [{"start_visited": 0.5}, {"horizon": 20}], ids=["visited starts", "horizon"])
def test_a_policy_search_over_whole_episodes_refuses_shortened_episodes(chosen: dict):
    with pytest.raises(ValueError, match="runs whole episodes"):
        search_for(TrainSettings(algorithm="cmaes", **chosen))
    search_for(TrainSettings(algorithm="fastppo", **chosen))


def test_start_visited_replaces_the_default_start_box_unless_both_are_given():
    assert TrainSettings(start_visited=0.5, horizon=20).learning == {
        "seed": 0,
        "start_box": 0.0,
        "start_visited": 0.5,
        "time_limit": 20,
    }
    both = TrainSettings(start_visited=0.5, start_box=0.25).learning
    assert (both["start_box"], both["start_visited"]) == (0.25, 0.5)
    assert "time_limit" not in TrainSettings(start_visited=0.5, horizon=20).judging, "policies run whole episodes"
