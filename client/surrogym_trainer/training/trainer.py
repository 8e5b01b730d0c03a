"""A training: run a policy search, save the policy, and write the settings and results beside it."""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from pathlib import Path

from surrogym_shared.port import SurrogatePort
from surrogym_shared.set_points import with_set_points
from surrogym_trainer.policies.card import card_path, require_place
from surrogym_trainer.policies.integrals import with_integrals
from surrogym_trainer.training.search import (
    Found,
    Progress,
    SearchTask,
    is_prolonged,
    name_of,
    planned_steps,
    search_for,
    with_algorithm,
)
from surrogym_trainer.training.settings import TrainingInterrupted, TrainResult, TrainSettings, with_folder


def train(
    port: SurrogatePort,
    out: Path,
    settings: TrainSettings | None = None,
    progress: Progress | None = None,
) -> TrainResult:
    """Train a policy in a surrogate, and save it.

    Args:
        port: the interface of the surrogate.
        out: file to write the policy to; its settings are written beside it, to a file with the suffix .json.
        settings: settings of the training, which name the search.
        progress: called after every rollout, generation or other unit of the search.

    Raises:
        ValueError: the algorithm is unknown or does not support the action space, there are too many steps, or the
            reward or the model does not support a set point or an integral.
        SurrogymClientError: the surrogate can't be reached, or has no model yet.
        UnusablePolicy: the file to start from is not a policy of the algorithm, or the card would replace another kind
            of file.
        Exception: a step failed, for example one of a user's simulator; the policy so far is saved, and a note of the
            exception says where.
        TrainingInterrupted: Ctrl-C was pressed; the policy with the best imagined return so far is saved.
    """
    require_place(out)
    settings = with_algorithm(settings or TrainSettings(), port.spec())
    with_set_points(port.spec(), settings.set_points)  # raises an error if the reward does not have them
    port = with_integrals(port, settings.integral, settings.set_points)
    search = search_for(settings)
    if search.tracked:
        settings = with_folder(settings, out)
    prolong = is_prolonged(settings, port.spec())
    task = SearchTask(port, settings, planned_steps(settings), out, prolong, progress or (lambda _: None))
    started = time.perf_counter()
    found = search.search(task)
    failure = found.stopped if isinstance(found.stopped, Exception) else None
    if failure is not None and not found.virtual_steps:
        raise failure
    out.parent.mkdir(parents=True, exist_ok=True)
    # The card (description) of an earlier policy must not remain beside this policy.
    card_path(out).unlink(missing_ok=True)
    found.policy.save(out)
    result = _result(found, settings, out, time.perf_counter() - started)
    card_path(out).write_text(json.dumps(asdict(result), indent=2, default=str) + "\n")
    if failure is not None:
        failure.add_note(
            f"the training stopped after {found.virtual_steps:,} virtual steps; the policy so far is in {out}, and "
            "start_from (--start-from) continues it"
        )
        raise failure
    if not found.whole:
        raise TrainingInterrupted(result)
    return result


def _result(found: Found, settings: TrainSettings, out: Path, seconds: float) -> TrainResult:
    return TrainResult(
        path=out,
        algorithm=found.algorithm or name_of(settings),
        virtual_steps=found.virtual_steps,
        seconds=seconds,
        imagined_return=found.imagined_return,
        lost_episodes=found.lost_episodes,
        settings={**asdict(settings), "start_box": settings.learning["start_box"], **found.settings},
        episode_penalty=found.episode_penalty,
        networks=found.networks,
        gaining=found.gaining,
        untrained=found.untrained,
    )
