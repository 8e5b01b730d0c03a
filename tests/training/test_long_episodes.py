"""A training has short episodes from anywhere if nothing ends the long ones of its task."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from support.models import learn
from support.plane import drifting, plane
from surrogym_client.training import TrainSettings, train
from surrogym_client.training.fast_ppo.long_episodes import LONG, MORE, SHORTER, with_short_episodes
from surrogym_client.training.search import SearchTask
from surrogym_server.convert import definition_from_spec
from surrogym_server.local import LocalSurrogate
from surrogym_shared.spec import EnvironmentSpec, Inequality, Term

ROLLOUT, LIMIT, STEPS = 16, 200, 1_000
FAR = Inequality(term=Term.linear(x=1), relation=">", value=0.9)


def task(settings: TrainSettings | None = None, *, prolong: bool = True, **changes: Any) -> SearchTask:
    spec: EnvironmentSpec = plane().model_copy(update={"time_limit": LIMIT, **changes})
    model = learn(definition_from_spec(spec), drifting(lambda q, u: q[:, 0] + u[:, 0], 12)).model
    return SearchTask(LocalSurrogate(spec, model), settings or TrainSettings(), STEPS, Path("policy.zip"), prolong)


def test_long_episodes_become_short_and_begin_anywhere():
    changed = with_short_episodes(task(), ROLLOUT)
    assert changed.settings.learning == {"seed": 0, "start_box": 1.0, "time_limit": LIMIT // SHORTER}
    assert changed.settings.judging == {}, "checks are whole episodes from the declared starts"
    assert (changed.steps, changed.prolong, changed.patient) == (MORE * STEPS, True, True)


def test_a_chosen_number_of_steps_is_kept():
    assert with_short_episodes(task(prolong=False), ROLLOUT).steps == STEPS


@pytest.mark.parametrize(
    "other",
    [
        {"time_limit": LONG * ROLLOUT},
        {"time_limit": None},
        {"termination": ((FAR,),)},
        {"settings": TrainSettings(start_box=0.5)},
        {"settings": TrainSettings(session={"time_limit": 150})},
    ],
    ids=["short episodes", "no time limit", "termination", "chosen starts", "chosen time limit"],
)
def test_another_training_is_unchanged(other: dict[str, Any]):
    given = task(**other)
    assert with_short_episodes(given, ROLLOUT) is given


def test_the_settings_of_the_policy_name_starts_and_episodes(tmp_path: Path):
    small = {"n_steps": ROLLOUT, "batch_size": 64, "n_epochs": 1}
    settings = TrainSettings(total_steps=2 * ROLLOUT * 8, num_envs=8, hyperparameters=small)
    result = train(task().port, tmp_path / "policy.zip", settings)
    assert (result.settings["start_box"], result.settings["time_limit"]) == (1.0, LIMIT // SHORTER)
