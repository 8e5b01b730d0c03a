"""Invariants that every policy search must keep, as functions for the tests of a search's author.

Examples:
    >>> @pytest.mark.parametrize("law", POLICY_SEARCH_LAWS)
    ... def test_my_search_keeps_the_laws(law, tmp_path):
    ...     settings = TrainSettings(algorithm="my_search", total_steps=20_000)
    ...     law(open_file("pendulum.surrogate"), settings, tmp_path)
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.actions import decode_actions
from surrogym_shared.port import SurrogatePort
from surrogym_shared.wire import OpenSession, SessionView
from surrogym_trainer.policies import load_policy
from surrogym_trainer.training import TrainingInterrupted, TrainProgress, TrainResult, TrainSettings, train
from surrogym_trainer.training.search import SEARCHES, name_of

OBSERVATIONS = 200


class LawBroken(AssertionError):
    """A policy search breaks an invariant; the message says what was expected and what the search did."""


def same_seed_gives_same_policy(port: SurrogatePort, settings: TrainSettings, folder: Path) -> None:
    """Check that two searches with one seed return the same actions, and that another seed returns different ones."""
    first, again, other = (
        _actions(port, train(port, folder / f"policy-{name}.zip", replace(settings, seed=seed)))
        for name, seed in (("first", settings.seed), ("again", settings.seed), ("other", settings.seed + 1))
    )
    _require(np.array_equal(first, again), "the same policy from the same seed", "another one")
    _require(not np.array_equal(first, other), "another policy from another seed", "the same one")


def steps_are_bounded_and_reported(port: SurrogatePort, settings: TrainSettings, folder: Path) -> None:
    """Check that progress never decreases or exceeds its total, and that the search takes at most the requested
    steps."""
    seen: list[TrainProgress] = []
    result = train(port, folder / "policy.zip", settings, seen.append)
    steps = [now.steps for now in seen]
    _require(bool(steps), "progress", "none")
    _require(steps == sorted(steps), "steps that never fall", steps)
    _require(all(now.steps <= now.total_steps for now in seen), "steps up to their total", steps)
    if settings.total_steps is not None:
        _require(result.virtual_steps <= settings.total_steps, f"{settings.total_steps} steps", result.virtual_steps)


def interruption_keeps_the_policy(port: SurrogatePort, settings: TrainSettings, folder: Path) -> None:
    """Check that Ctrl-C at the first report of progress leaves a readable policy or none, and no open session."""
    watched, out = _Watched(port), folder / "policy.zip"
    try:
        train(watched, out, settings, _interrupt)
        raise LawBroken("expected the search to stop on Ctrl-C, got one that continued to its end")
    except TrainingInterrupted as interruption:
        _actions(port, interruption.result)
    except KeyboardInterrupt:
        _require(not out.exists(), "no file where there is no policy", out)
    _require(not watched.open_sessions, "all sessions closed after Ctrl-C", watched.open_sessions)


def sessions_are_closed(port: SurrogatePort, settings: TrainSettings, folder: Path) -> None:
    """Check that the search leaves no session open, whether it succeeds or fails."""
    watched = _Watched(port)
    train(watched, folder / "policy.zip", settings)
    _require(not watched.open_sessions, "all sessions closed at the end", watched.open_sessions)
    with suppress(_Failure):
        train(watched, folder / "policy.zip", settings, _fail)
    _require(not watched.open_sessions, "all sessions closed after an error", watched.open_sessions)


def unknown_hyperparameters_are_refused(port: SurrogatePort, settings: TrainSettings, folder: Path) -> None:
    """Check that an unknown hyperparameter raises ValueError and leaves no file."""
    asked = replace(settings, hyperparameters={**settings.hyperparameters, "no_such_hyperparameter": 1})
    try:
        train(port, folder / "policy.zip", asked)
    except ValueError as error:
        _require("no_such_hyperparameter" in str(error), "an error that names the hyperparameter", str(error))
    else:
        raise LawBroken("expected ValueError for an unknown hyperparameter, got a trained policy")
    _require(not list(folder.iterdir()), "no file", sorted(path.name for path in folder.iterdir()))


def start_is_taken_or_refused(port: SurrogatePort, settings: TrainSettings, folder: Path) -> None:
    """Check that the search continues from its own policy file, or refuses to if it declares that it can't."""
    start = train(port, folder / "start.zip", replace(settings, seed=settings.seed + 1)).path
    resumed = replace(settings, start_from=start)
    if SEARCHES.get(name_of(settings)).resumable:
        _actions(port, train(port, folder / "policy.zip", resumed))
        return
    try:
        train(port, folder / "policy.zip", resumed)
    except ValueError:
        return
    raise LawBroken("expected ValueError for start_from, as the search is not resumable, got a trained policy")


def policy_is_read_without_trust(port: SurrogatePort, settings: TrainSettings, folder: Path) -> None:
    """Check that the policy file loads without unpickling, and returns actions of the action space."""
    result = train(port, folder / "policy.zip", settings)
    actions = _actions(port, result)
    _require(bool(np.isfinite(actions).all()), "finite actions", "others")
    _require(result.path.with_suffix(".json").exists(), "a file of settings beside the policy", "none")


POLICY_SEARCH_LAWS = (
    same_seed_gives_same_policy,
    steps_are_bounded_and_reported,
    interruption_keeps_the_policy,
    sessions_are_closed,
    unknown_hyperparameters_are_refused,
    start_is_taken_or_refused,
    policy_is_read_without_trust,
)


class _Failure(Exception):
    """Error that ``sessions_are_closed`` raises in the progress callback of a search."""


class _Watched:
    """An interface of a surrogate (port) that forwards all calls to another one, and records which sessions are
    open."""

    def __init__(self, port: SurrogatePort) -> None:
        self._port = port
        self.open_sessions: set[str] = set()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._port, name)

    def spec(self) -> Any:
        return self._port.spec()

    def open(self, request: OpenSession) -> SessionView:
        view = self._port.open(request)
        self.open_sessions.add(view.id)
        return view

    def close(self, session: str) -> None:
        self._port.close(session)
        self.open_sessions.discard(session)


def _actions(port: SurrogatePort, result: TrainResult) -> NDArray[np.float64]:
    """Return the actions (OBSERVATIONS, F) of a policy file for random observations."""
    spec = port.spec()
    rng = np.random.default_rng(0)
    observations = rng.normal(size=(OBSERVATIONS, len(spec.observation))).astype(np.float32)
    return decode_actions(spec, load_policy(result.path, result.algorithm)(observations), OBSERVATIONS)


def _interrupt(_: TrainProgress) -> None:
    raise KeyboardInterrupt


def _fail(_: TrainProgress) -> None:
    raise _Failure


def _require(held: bool, expected: str, got: object) -> None:
    if not held:
        raise LawBroken(f"expected {expected}, got {got}")
