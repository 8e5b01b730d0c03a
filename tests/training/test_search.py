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
def test_the_fast_search_is_chosen_unless_only_its_reference_serves(chosen: dict, spec, name: str):
    assert with_algorithm(TrainSettings(**chosen), spec).algorithm == name


def test_a_policy_of_stable_baselines3_is_continued_by_its_own_library(tmp_path: Path):
    start = tmp_path / "policy.zip"
    start.write_bytes(b"no network of arrays")
    assert with_algorithm(TrainSettings(start_from=start), pendulum()).algorithm == "PPO"


def test_a_tracker_is_refused_where_nothing_is_logged():
    with pytest.raises(ValueError, match="FASTPPO reports to no tracker: leave mlflow out"):
        search_for(TrainSettings("fastppo", tracker="mlflow"))


@pytest.mark.parametrize("chosen", [{"start_visited": 0.5}, {"horizon": 20}], ids=["visited starts", "horizon"])
def test_a_search_over_whole_episodes_refuses_parts_of_them(chosen: dict):
    with pytest.raises(ValueError, match="runs whole episodes"):
        search_for(TrainSettings(algorithm="cmaes", **chosen))
    search_for(TrainSettings(algorithm="fastppo", **chosen))


def test_visited_starts_replace_those_anywhere_unless_both_are_chosen():
    assert TrainSettings(start_visited=0.5, horizon=20).learning == {
        "seed": 0,
        "start_box": 0.0,
        "start_visited": 0.5,
        "time_limit": 20,
    }
    both = TrainSettings(start_visited=0.5, start_box=0.25).learning
    assert (both["start_box"], both["start_visited"]) == (0.25, 0.5)
    assert "time_limit" not in TrainSettings(start_visited=0.5, horizon=20).judging, "policies run whole episodes"
