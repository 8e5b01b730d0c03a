"""A training goes on where an audit fails, and where the model that has learned from it promises clearly less."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from surrogym_trainer.policies.evidence import Audit, Promise
from surrogym_trainer.training import audited
from surrogym_trainer.training.audited import MOST_AUDITS, AuditedTraining
from surrogym_trainer.training.closed_loop import LoopSettings
from surrogym_trainer.training.handover import AuditSettings, Handover
from surrogym_trainer.training.settings import TrainResult, TrainSettings


def promise(median: float, low: float | None = None, high: float | None = None) -> Promise:
    low, high = median if low is None else low, median if high is None else high
    return Promise(median=median, low=low, high=high, functions=32, episodes=256)


def found(before: float, after: float, passed: bool = True, low: float | None = None) -> Handover:
    audit = Audit(steps=8, passed=passed, before=promise(before, -32, 102), after=promise(after, low))
    return Handover(audit.after, audit, passed, "because")


@dataclass
class Trainings:
    """Stands for trainings and audits: what each audit finds, and how many trainings there were."""

    audits: list[Handover]
    imagined: float | None = None
    made: int = 0
    trained_from: list[Path | None] = field(default_factory=list)

    def train(self, _port: Any, out: Path, settings: TrainSettings, _progress: Any) -> TrainResult:
        self.made += 1
        self.trained_from.append(settings.start_from)
        out.write_bytes(b"policy %d" % self.made)
        return TrainResult(out, "fastppo", 100, 1.0, self.imagined, 0, {}, untrained=0.0)

    def hand_over(self, *_: Any) -> Handover:
        return self.audits[self.made - 1]


def run(
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
    *audits: Handover,
    imagined: float | None = None,
    steps: int | None = None,
) -> tuple[Trainings, TrainResult, Handover]:
    trainings, api = Trainings(list(audits), imagined), Mock()
    api.surrogate.return_value.fidelity = None
    api.surrogate.return_value.budget_left = 0
    api.surrogate.return_value.ledger.total = 8
    monkeypatch.setattr(audited, "train", trainings.train)
    monkeypatch.setattr(audited, "hand_over", trainings.hand_over)
    monkeypatch.setattr(AuditedTraining, "_subject", lambda *_: None)
    monkeypatch.setattr(AuditedTraining, "_best", lambda _self, result: result)
    settings = TrainSettings(algorithm="fastppo", total_steps=steps)
    training = AuditedTraining(api, "plane", Mock(), folder / "p.zip", settings, audit=AuditSettings())
    return trainings, *training.train()


def test_a_training_continues_if_the_audit_clearly_lowers_the_promised_return(monkeypatch, tmp_path: Path) -> None:
    trainings, result, handover = run(monkeypatch, tmp_path, found(95.6, -21.6), found(97.4, 97.5))
    assert (trainings.made, result.virtual_steps) == (2, 200)
    assert trainings.trained_from == [None, tmp_path / "p.zip"]
    assert handover.promise.median == 97.5


def test_a_training_continues_if_the_promised_return_is_far_below_the_imagined(monkeypatch, tmp_path: Path) -> None:
    trainings, _, _ = run(monkeypatch, tmp_path, found(52.6, 69.7), found(97.4, 97.5), imagined=99.4)
    assert trainings.made == 2


def test_a_training_with_a_step_limit_does_not_continue_after_an_audit(monkeypatch, tmp_path: Path) -> None:
    trainings, _, _ = run(monkeypatch, tmp_path, found(95.6, -21.6), steps=100)
    assert trainings.made == 1


def test_an_imagined_return_below_the_promised_one_causes_no_further_training(monkeypatch, tmp_path: Path) -> None:
    trainings, _, _ = run(monkeypatch, tmp_path, found(95.6, 94.0), imagined=60.0)
    assert trainings.made == 1


@pytest.mark.parametrize("after", [94.0, 120.0])
def test_training_ends_if_the_promised_return_stays_or_grows_after_the_audit(
    monkeypatch, tmp_path: Path, after: float
) -> None:
    trainings, _, handover = run(monkeypatch, tmp_path, found(95.6, after))
    assert trainings.made == 1
    assert handover.trusted


def test_after_a_failed_audit_training_continues_if_the_promised_return_fell(monkeypatch, tmp_path: Path) -> None:
    trainings, _, handover = run(monkeypatch, tmp_path, found(95.6, -21.6, passed=False), found(97.4, 97.5))
    assert trainings.made == 2
    assert handover.trusted


def test_after_a_failed_audit_with_unchanged_promised_return_the_policy_is_untrusted(
    monkeypatch, tmp_path: Path
) -> None:
    trainings, _, handover = run(monkeypatch, tmp_path, found(95.6, 94.0, passed=False))
    assert trainings.made == 1
    assert not handover.trusted


def test_a_policy_is_untrusted_if_no_second_audit_follows_a_failed_one(monkeypatch, tmp_path: Path) -> None:
    """The sampler has gone, or the audits have taken all their steps: a ready design alone was trusted then."""
    unaudited = Handover(promise(97.5), None, True, "the design is ready; not audited: no sampler is connected")
    trainings, _, handover = run(monkeypatch, tmp_path, found(95.6, -21.6, passed=False), unaudited)
    assert trainings.made == 2
    assert not handover.trusted
    assert handover.reason.startswith("the audit before failed, and the policy trained since has none")


def test_training_ends_if_the_audit_found_that_the_machine_is_not_as_declared(monkeypatch, tmp_path: Path) -> None:
    """The next audit may have begun at a declared start, and the promise would have been trusted."""
    failed = found(95.6, -21.6, passed=False)
    undeclared = replace(failed, audit=failed.audit.model_copy(update={"undeclared": True}))
    trainings, _, handover = run(monkeypatch, tmp_path, undeclared, found(97.4, 97.5))
    assert trainings.made == 1
    assert not handover.trusted


def test_training_stops_after_a_limited_number_of_audits(monkeypatch, tmp_path: Path) -> None:
    trainings, _, handover = run(monkeypatch, tmp_path, *[found(95.6, -21.6)] * MOST_AUDITS)
    assert trainings.made == MOST_AUDITS
    assert handover.promise.median == -21.6


def rounds_taken(
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
    *,
    passed: bool,
    unspent: int,
    role: str = "admin",
    phase: str = "over_budget",
    certain: float | None = 1.0,
    low: float | None = None,
    index: float = 0.9995,
) -> tuple[list[int], int]:
    """Run audits that all end alike, with a budget that has none left. Returns the real steps of each round that was
    taken after an audit, and the number of trainings."""
    api, ledger = Mock(), Mock(total=24)
    api.access.return_value.role = role
    view = Mock(budget_left=0, ledger=ledger, fidelity=None, phase=phase, target=0.999, confidence_index=index)
    api.surrogate.return_value = view
    api.improve.side_effect = lambda _name, queries, **_: setattr(ledger, "total", ledger.total + queries)
    trainings = Trainings([found(95.6, 94.0, passed, low)] * MOST_AUDITS)
    loop = Mock(unspent=unspent, train=lambda: trainings.train(None, folder / "p.zip", TrainSettings(), None))
    monkeypatch.setattr(audited, "ClosedLoop", lambda *_: loop)
    monkeypatch.setattr(audited, "allows_trials", lambda *_: False)
    monkeypatch.setattr(audited, "train", trainings.train)
    monkeypatch.setattr(audited, "hand_over", trainings.hand_over)
    monkeypatch.setattr(audited, "visit", lambda *_: (0, certain))
    monkeypatch.setattr(audited, "wait_for_design", lambda *_, **__: api.surrogate())
    monkeypatch.setattr(AuditedTraining, "_subject", lambda *_: None)
    monkeypatch.setattr(AuditedTraining, "_best", lambda _self, result: result)
    settings, rounds = TrainSettings(algorithm="fastppo"), LoopSettings(queries=12, rounds=3)
    AuditedTraining(api, "plane", Mock(), folder / "p.zip", settings, rounds, AuditSettings()).train()
    return [call.args[1] for call in api.improve.call_args_list], trainings.made


@pytest.mark.parametrize(
    ("role", "unspent", "improved"), [("admin", 0, []), ("admin", 1, [12]), ("admin", 2, [12, 12]), ("trainer", 2, [])]
)
def test_after_a_failed_audit_the_unspent_real_steps_of_earlier_rounds_are_taken(
    monkeypatch, tmp_path: Path, role: str, unspent: int, improved: list[int]
) -> None:
    """The budget has none left: the loop raises it by a round's steps, and it took none where the model seemed sure."""
    taken, made = rounds_taken(monkeypatch, tmp_path, passed=False, unspent=unspent, role=role)
    assert (taken, made) == (improved, 1 + len(improved))


@pytest.mark.parametrize(
    ("unspent", "phase", "certain", "improved"),
    [
        (3, "over_budget", 0.9, [12, 12]),
        (1, "over_budget", 0.9, [12]),
        (0, "over_budget", 0.9, []),
        (3, "over_budget", 0.9995, []),
        (3, "over_budget", None, []),
        (3, "ready", 0.9, []),
    ],
)
def test_after_a_passed_audit_unspent_steps_are_taken_if_visited_states_became_uncertain(
    monkeypatch, tmp_path: Path, unspent: int, phase: str, certain: float | None, improved: list[int]
) -> None:
    taken, made = rounds_taken(monkeypatch, tmp_path, passed=True, unspent=unspent, phase=phase, certain=certain)
    assert (taken, made) == (improved, 1 + len(improved))


def test_after_an_audit_unspent_steps_are_taken_if_the_designs_confidence_fell(monkeypatch, tmp_path: Path) -> None:
    taken, _ = rounds_taken(monkeypatch, tmp_path, passed=True, unspent=3, phase="ready", certain=0.9, index=0.9986)
    assert taken == [12, 12]


@pytest.mark.parametrize(
    ("low", "unspent", "phase", "improved"),
    [
        (74.0, 3, "over_budget", [12, 12]),
        (74.0, 3, "ready", [12, 12]),
        (74.0, 0, "over_budget", []),
        (76.0, 3, "over_budget", []),
    ],
)
def test_after_a_passed_audit_unspent_steps_are_taken_if_the_promised_interval_is_wide(
    monkeypatch, tmp_path: Path, low: float, unspent: int, phase: str, improved: list[int]
) -> None:
    """94 is promised, beyond an untrained policy's 0. A fifth of that is 18.8."""
    taken, made = rounds_taken(monkeypatch, tmp_path, passed=True, unspent=unspent, phase=phase, low=low)
    assert (taken, made) == (improved, 1 + len(improved))
