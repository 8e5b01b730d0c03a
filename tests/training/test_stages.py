"""Episodes of the two stages of a training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from support.plane import plane
from surrogym_trainer.training import TrainSettings
from surrogym_trainer.training.fast_ppo.search import LONG, SHORTER, SHORTEST, SIGHT, learn, refine
from surrogym_trainer.training.search import SearchTask
from surrogym_trainer.training.settings import suggested_gamma


class Described:
    """A port that knows its specification alone."""

    def __init__(self, limit: int | None, **changes: Any) -> None:
        self._spec = plane().model_copy(update={"time_limit": limit, **changes})

    def spec(self):
        return self._spec


def task(settings: TrainSettings | None = None, limit: int | None = 500, **changes: Any) -> SearchTask:
    port: Any = Described(limit, **changes)
    return SearchTask(port, settings or TrainSettings(), 1_000, Path("policy.zip"))


@pytest.mark.parametrize(
    ("limit", "length"), [(500, 500 // SHORTER), (60, SHORTEST), (20, 20)], ids=["long", "a few steps", "fewer"]
)
def test_first_stage_training_episodes_are_short_and_half_start_anywhere(limit: int, length: int):
    stage = learn(task(limit=limit, termination="learned"))
    assert stage.settings.learning == {"seed": 0, "start_box": 0.5, "time_limit": length}
    assert not stage.long
    assert stage.settings.judging == {}, "checks are whole episodes from the declared starts"
    assert stage.gamma == pytest.approx(1 - 1 / (SIGHT * length))


def test_all_episodes_of_the_first_stage_start_anywhere_if_nothing_ends_long_ones():
    stage = learn(task(limit=LONG + 1))
    assert stage.long
    assert stage.settings.learning == {"seed": 0, "start_box": 1.0, "time_limit": LONG // SHORTER}
    assert stage.gamma == pytest.approx(1 - SHORTER / LONG), "it looks a whole short episode ahead"
    assert not learn(task(limit=LONG)).long
    assert not learn(task(TrainSettings(start_box=0.2))).long, "starts that the user chose are kept"


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
