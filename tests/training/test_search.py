"""The choice of a policy search where a training names none."""

from pathlib import Path

import pytest

from surrogym_sampler.original.classic import pendulum
from surrogym_shared.spec import BoxAction, Design, EnvironmentSpec, with_history
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


LATE = with_history(pendulum().model_copy(update={"query": "rollout"}), actions=3)


def changed(spec: EnvironmentSpec, **fields: object) -> EnvironmentSpec:
    return spec.model_copy(update=fields)


@pytest.mark.parametrize(
    ("chosen", "spec", "name"),
    [
        ({}, LATE, "PLANNER"),
        ({"hyperparameters": {"horizon": 20}}, LATE, "PLANNER"),
        ({"session": {"set_points": {"theta": 0.1}}, "seed": 3, "threads": 2}, LATE, "PLANNER"),
        ({"total_steps": 20_000}, LATE, "FASTPPO"),
        ({"integral": ("theta",)}, LATE, "FASTPPO"),
        ({"hyperparameters": {"n_epochs": 3}}, LATE, "FASTPPO"),
        ({}, changed(pendulum(), query="rollout"), "FASTPPO"),
        ({}, changed(LATE, snapshots=True), "FASTPPO"),
        ({}, changed(LATE, design=Design(model="ensemble")), "FASTPPO"),
        ({}, changed(LATE, action=BoxAction(low=(-2,), high=(2,), bins=(5,))), "FASTPPO"),
        ({}, with_history(LATE, changes=2, largest={"theta": 1.0, "speed": 4.0}), "FASTPPO"),
    ],
    ids=[
        "a dead time",
        "a planner's hyperparameter",
        "what a planner has, too",
        "virtual steps",
        "an integral",
        "a network's hyperparameter",
        "no dead time",
        "saved states",
        "another family",
        "bins",
        "too many coordinates besides the actions",
    ],
)
def test_a_planner_is_the_default_for_a_machine_with_a_dead_time(chosen: dict, spec: EnvironmentSpec, name: str):
    assert with_algorithm(TrainSettings(**chosen), spec).algorithm == name
    assert spec.needs_trials == (len(spec.coordinates) > 4 and not spec.fits_planner and spec.access == "reset")


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


def test_a_horizon_that_no_planner_supports_is_refused_before_the_search_begins():
    with pytest.raises(ValueError, match="horizon: expected a whole number of steps from 1 to 200, got 500"):
        search_for(TrainSettings("PLANNER", hyperparameters={"horizon": 500}))
