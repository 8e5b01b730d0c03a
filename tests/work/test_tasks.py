"""What a task means for the code of ``surrogym train``."""

from __future__ import annotations

from typing import get_args

import pytest

from surrogym_sampler.original.classic import pendulum
from surrogym_shared import wire
from surrogym_trainer.training.search import SEARCHES
from surrogym_trainer.work.tasks import QUICK, settings_of


def test_a_training_job_without_options_trains_like_the_train_command():
    settings = settings_of(wire.TrainTask(kind="train", seed=7), pendulum())
    assert (settings.algorithm, settings.total_steps, settings.prolong) == ("FASTPPO", None, None)
    assert (settings.seed, settings.tracker, settings.hyperparameters) == (7, None, {})


def test_a_quick_training_job_takes_fewer_steps_and_is_never_extended():
    settings = settings_of(wire.TrainTask(kind="train", algorithm="cmaes", preset="quick"), pendulum())
    assert settings.total_steps == SEARCHES.get("CMAES").suggested_steps // QUICK
    assert settings.prolong is False


@pytest.mark.parametrize("name", get_args(wire.JobAlgorithm))
def test_every_algorithm_of_a_training_job_is_a_known_policy_search(name: str):
    assert SEARCHES.name_of(name) == name.upper()
