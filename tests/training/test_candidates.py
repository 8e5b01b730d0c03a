"""What is handed over is never clearly worse, in the model of all real steps, than a policy that the training had."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from support.moody import SPEC, Line
from surrogym_client.errors import SurrogymClientError
from surrogym_lab.original_port import OriginalPort
from surrogym_sampler.original.episodes import SteppedEpisode
from surrogym_shared.wire import OpenSession, SessionView
from surrogym_trainer.policies.predict import Predict
from surrogym_trainer.training import audited
from surrogym_trainer.training.audited import AuditedTraining
from surrogym_trainer.training.closed_loop import Candidates
from surrogym_trainer.training.settings import TrainingInterrupted, TrainResult, TrainSettings

POLICIES = {
    b"to the middle": lambda o: -np.clip(10 * o[:, :1], -1, 1),
    b"slowly to the middle": lambda o: -np.clip(o[:, :1], -1, 1) / 2,
    b"away": lambda o: np.where(o[:, :1] > 0, 1.0, -1.0),
}


class Lines(Line):
    parallel = True


def load(path: Path, algorithm: str) -> Predict:
    return POLICIES[path.read_bytes()]


@pytest.fixture
def port() -> OriginalPort:
    """The model of all real steps, which is right: the environment itself."""
    return OriginalPort(SPEC, lambda: SteppedEpisode(Lines()))


def trained(path: Path, policy: bytes, steps: int) -> TrainResult:
    path.write_bytes(policy)
    return TrainResult(path, "fastppo", steps, 1.0, None, 0, {})


@pytest.mark.parametrize("later", [b"slowly to the middle", b"away"])
def test_an_earlier_policy_replaces_a_clearly_worse_later_one(port, tmp_path: Path, later: bytes) -> None:
    candidates, path = Candidates(load), tmp_path / "policy.zip"
    candidates.keep(trained(path, b"away", 100))
    candidates.keep(trained(path, b"to the middle", 200))
    latest = replace(trained(path, later, 300), lost_episodes=2)
    best = candidates.best(port, latest, TrainSettings())
    assert path.read_bytes() == b"to the middle"
    assert (best.virtual_steps, best.lost_episodes) == (300, 2), "all that was spent"


def test_a_better_later_policy_is_kept(port, tmp_path: Path) -> None:
    candidates, path = Candidates(load), tmp_path / "policy.zip"
    candidates.keep(trained(path, b"away", 100))
    latest = trained(path, b"to the middle", 200)
    assert candidates.best(port, latest, TrainSettings()) is latest
    assert path.read_bytes() == b"to the middle"


def test_identical_candidate_policies_are_not_compared(port, tmp_path: Path) -> None:
    candidates, path = Candidates(load), tmp_path / "policy.zip"
    latest = trained(path, b"away", 100)
    candidates.keep(latest)
    assert candidates.best(port, latest, TrainSettings()) is latest
    assert port.steps == 0


def test_an_unreadable_candidate_policy_leaves_the_latest_one_in_place(port, tmp_path: Path) -> None:
    candidates, path = Candidates(load), tmp_path / "policy.zip"
    candidates.keep(trained(path, b"broken", 100))
    latest = trained(path, b"to the middle", 200)
    with pytest.raises(KeyError):
        candidates.best(port, latest, TrainSettings())
    assert path.read_bytes() == b"to the middle"


def test_ctrl_c_while_policies_are_compared_hands_over_the_best_of_those_compared(port, tmp_path: Path) -> None:
    def interrupted(path: Path, algorithm: str) -> Predict:
        if path.read_bytes() == b"away":
            raise KeyboardInterrupt
        return load(path, algorithm)

    candidates, path = Candidates(interrupted), tmp_path / "policy.zip"
    for policy in (b"to the middle", b"away"):
        candidates.keep(replace(trained(path, policy, 100), settings={"made": policy}))
    latest = trained(path, b"slowly to the middle", 300)
    with pytest.raises(TrainingInterrupted) as stopped:
        candidates.best(port, latest, TrainSettings())
    assert path.read_bytes() == b"to the middle" == stopped.value.result.settings["made"], "result and file agree"
    assert stopped.value.result.virtual_steps == 300


class Audited(AuditedTraining):
    """One that asks no server how to train."""

    _chosen = TrainSettings()  # type: ignore[assignment]


class Gone(OriginalPort):
    """A surrogate whose server has ended."""

    def open(self, request: OpenSession) -> SessionView:
        raise SurrogymClientError("the server has ended")


@pytest.mark.parametrize(("gone", "left"), [(False, b"to the middle"), (True, b"away")])
def test_a_training_that_is_cut_off_after_an_audit_leaves_the_best_policy(
    port, gone: bool, left: bytes, tmp_path: Path, monkeypatch
) -> None:
    """Without the surrogate nothing can be compared, and the latest policy stays."""

    def cut_off(*_: object) -> None:
        raise TrainingInterrupted(trained(path, b"away", 50))

    path = tmp_path / "policy.zip"
    monkeypatch.setattr(audited, "train", cut_off)
    now = Gone(SPEC, lambda: SteppedEpisode(Lines())) if gone else port
    training = Audited(None, "line", now, path, TrainSettings())  # type: ignore[arg-type]
    training.candidates.load = load
    first = trained(path, b"to the middle", 100)
    training.candidates.keep(first)
    with pytest.raises(TrainingInterrupted) as stopped:
        training._train_on(first)
    assert path.read_bytes() == left
    assert stopped.value.result.virtual_steps == 150


def test_a_planner_by_default_is_made_anew_after_an_audit(port, tmp_path: Path, monkeypatch) -> None:
    path, seen = tmp_path / "policy.zip", []
    monkeypatch.setattr(audited, "train", lambda _, __, now, *___: seen.append(now) or trained(path, b"away", 0))
    monkeypatch.setattr(Audited, "_chosen", TrainSettings("PLANNER"))
    Audited(None, "line", port, path, TrainSettings())._train_on(trained(path, b"away", 0))  # type: ignore[arg-type]
    assert seen[0].start_from is None, "it can't begin from a policy"


def test_the_policy_of_each_training_after_an_audit_is_a_candidate_for_the_result(
    port, tmp_path: Path, monkeypatch
) -> None:
    path, later = tmp_path / "policy.zip", iter([b"to the middle", b"slowly to the middle"])
    monkeypatch.setattr(audited, "train", lambda *_: trained(path, next(later), 100))
    training = Audited(None, "line", port, path, TrainSettings())  # type: ignore[arg-type]
    training.candidates.load = load
    result = trained(path, b"away", 100)
    training.candidates.keep(result)
    for _ in range(2):
        result = training._train_on(result)
    assert path.read_bytes() == b"to the middle"
    assert result.virtual_steps == 300
