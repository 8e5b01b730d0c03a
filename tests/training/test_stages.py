"""Episodes of the two stages of a training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from support.plane import plane
from surrogym_trainer.training import TrainSettings
from surrogym_trainer.training.fast_ppo.search import SHORTER, SHORTEST, SIGHT, learn, refine
from surrogym_trainer.training.search import SearchTask
from surrogym_trainer.training.settings import suggested_gamma


class Described:
    """A port that knows its specification alone."""

    def __init__(self, limit: int | None) -> None:
        self._spec = plane().model_copy(update={"time_limit": limit})

    def spec(self):
        return self._spec


def task(settings: TrainSettings | None = None, limit: int | None = 500) -> SearchTask:
    port: Any = Described(limit)
    return SearchTask(port, settings or TrainSettings(), 1_000, Path("policy.zip"))


@pytest.mark.parametrize(
    ("limit", "length"), [(500, 500 // SHORTER), (60, SHORTEST), (20, 20)], ids=["long", "a few steps", "fewer"]
)
def test_first_stage_training_episodes_are_short_and_half_start_anywhere(limit: int, length: int):
    stage = learn(task(limit=limit))
    assert stage.settings.learning == {"seed": 0, "start_box": 0.5, "time_limit": length}
    assert stage.settings.judging == {}, "checks are whole episodes from the declared starts"
    assert stage.gamma == pytest.approx(1 - 1 / (SIGHT * length))


@pytest.mark.parametrize(
    "chosen",
    [{"start_box": 0.2}, {"session": {"time_limit": 150}}, {"horizon": 20}, {"start_visited": 0.5}],
    ids=["starts", "limit", "horizon", "visited states"],
)
def test_training_stages_keep_start_and_episode_length_settings_of_the_user(chosen: dict[str, Any]):
    given = task(TrainSettings(**chosen))
    stage = learn(given)
    assert stage.settings == given.settings
    assert stage.gamma == suggested_gamma(given.port.spec())


def test_second_stage_training_uses_whole_episodes_from_declared_starts():
    stage = refine(task(TrainSettings(session={"variant": "pathwise"}, horizon=20)))
    assert stage.settings.learning == {"seed": 0, "start_box": 0.0, "start_visited": 0.0, "variant": "pathwise"}
    assert stage.gamma == suggested_gamma(plane().model_copy(update={"time_limit": 500}))
