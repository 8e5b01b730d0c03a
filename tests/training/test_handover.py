"""Handing a policy over: real steps on its way show a wrong model, and cost none of the budget."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock
from uuid import uuid4

import numpy as np
import pytest

from support import limited, rail, wheel
from support.moody import DECLARED, SPEC, Line
from support.server import ServerProcess
from surrogym.cli import main
from surrogym.cli.commands.audit import by_episodes
from surrogym_client.errors import UnknownSurrogate
from surrogym_client.surrogates import waiting
from surrogym_client.surrogates.waiting import wait_for_design
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_sampler.original import RealStep
from surrogym_sampler.original.episode import Episode
from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.original.rollouts import answering, keeping_limits
from surrogym_sampler.queries import Sampler, SamplerSettings
from surrogym_shared.network import Layer, Network
from surrogym_shared.spec import Design, EnvironmentSpec, ModelChoice, Uniform
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, evaluate
from surrogym_trainer.policies.card import PolicyCard, read_card, write_card
from surrogym_trainer.policies.integrals import with_integrals
from surrogym_trainer.training import TrainSettings, handover
from surrogym_trainer.training.audited import AuditedTraining
from surrogym_trainer.training.handover import NO_SAMPLER, AuditSettings, Subject, hand_over, judge_episodes, way_of

AUDIT = AuditSettings(patience_seconds=60.0)


class Changed(Line):
    """The line once somebody has changed it: what was paid on the left is not paid any more."""

    changed = False

    def step_from(self, coordinates: np.ndarray, action: np.ndarray) -> RealStep:
        step = super().step_from(coordinates, action)
        return replace(step, reward=step.reward - 3.0) if self.changed else step


@dataclass
class Place:
    """A surrogate of a line, and the environment that a sampler has beside it."""

    api: Api
    port: HttpSurrogate
    environment: Changed

    @property
    def name(self) -> str:
        return self.port.surrogate

    def subject(self) -> Subject:
        return Subject(self.api, self.name, self.port, lambda o: -np.sign(o[:, :1]), floor=-10.0)


@pytest.fixture
def line(server_process: ServerProcess) -> Iterator[Place]:
    with placed(server_process.url, SPEC, Changed()) as place:
        yield place


@contextmanager
def placed(url: str, spec: EnvironmentSpec, environment: Any, design: Design | None = None) -> Iterator[Place]:
    """A surrogate whose design has ended, with a sampler in a thread."""
    name = f"handed-{uuid4().hex[:8]}"
    spec = spec.model_copy(update={"design": design or Design(initial=8, budget=16)})
    settings = SamplerSettings(name="beside", wait_seconds=1.0, time_limit=120.0)
    with Api(url) as api, Api(url) as own, HttpSurrogate(url, name) as port:
        api.create_surrogate(name, spec)
        thread = threading.Thread(target=_until_deleted, args=(Sampler(own, name, environment, settings),))
        thread.start()
        try:
            wait_for_design(api, name, 240)  # seconds, on a busy machine
            yield Place(api, port, environment)
        finally:
            api.delete_surrogate(name)
            thread.join(30)


def _until_deleted(sampler: Sampler) -> None:
    with suppress(UnknownSurrogate):
        sampler.run()


def test_a_correct_model_passes_the_audit_and_audit_steps_cost_no_budget(line: Place) -> None:
    before = line.api.surrogate(line.name)
    handover = hand_over(line.subject(), AUDIT)
    after = line.api.surrogate(line.name)
    assert handover.trusted, handover.reason
    assert handover.audit is not None
    assert handover.audit.steps == 8
    assert handover.model == line.api.model(line.name).data_hash, "of the model that has learned from the audit"
    assert after.ledger.audit == 8
    assert after.ledger.total == before.ledger.total, "an audit costs none of the budget"
    assert after.budget_left == before.budget_left
    assert after.samples == before.samples + 8, "the model learns from the audit"


def test_a_policy_promising_no_more_than_an_untrained_one_is_not_trusted(line: Place) -> None:
    """A promise without width passed for a sure one, where no policy could change the return."""
    best = hand_over(line.subject(), None).promise
    assert best is not None
    handover = hand_over(replace(line.subject(), floor=best.high), None)
    assert not handover.trusted
    assert handover.reason.startswith("the promise is no more than the return of an untrained policy")


def test_a_changed_environment_fails_the_audit(line: Place) -> None:
    line.environment.changed = True
    handover = hand_over(line.subject(), AUDIT)
    assert not handover.trusted
    assert handover.audit is not None
    assert handover.audit.faults[0].startswith("reward: errors of 3")
    assert handover.promise.median < handover.audit.before.median - 10, "the model has learned what is paid now"


class Bowl(Changed):
    """The line, paid by -x^2 instead of -|x|, which has no kink."""

    def step_from(self, coordinates: np.ndarray, action: np.ndarray) -> RealStep:
        step, x = super().step_from(coordinates, action), float(coordinates[0])
        return replace(step, reward=step.reward + abs(x) - x**2)


@pytest.mark.parametrize("wrong", [True, False])
def test_an_ensemble_whose_members_agree_but_are_wrong_fails_the_audit(
    server_process: ServerProcess, wrong: bool
) -> None:
    """Their disagreement can't show it: all have learned from the same samples."""
    choice = ModelChoice(name="ensemble", settings={"members": 4, "units": 32, "steps": 600})
    with placed(server_process.url, SPEC, Bowl(), Design(initial=24, budget=28, model=choice)) as place:
        place.environment.changed = wrong
        handover = hand_over(place.subject(), AUDIT)
        assert handover.audit is not None
        before = handover.audit.before
        assert before.high - before.low < 5, "they agree: an episode of 20 steps loses 60"
        assert handover.trusted is not wrong
        assert any(fault.startswith("reward: errors of") for fault in handover.audit.faults) is wrong


class Slope(Line):
    """The line, paid by how far left it is. Once it is changed, nothing is paid far right, where no policy goes."""

    changed = False

    def step_from(self, coordinates: np.ndarray, action: np.ndarray) -> RealStep:
        step, x = super().step_from(coordinates, action), float(coordinates[0])
        return replace(step, reward=0.0 if self.changed and x > 0.6 else 1 - x)


def test_the_audit_of_a_ready_design_includes_gaps_between_its_samples(server_process: ServerProcess) -> None:
    with placed(server_process.url, SPEC, Slope()) as place:
        assert place.api.surrogate(place.name).phase == "ready"
        handover = hand_over(place.subject(), AUDIT)
        assert handover.trusted, handover.reason
        assert (
            handover.reason
            == "6 real steps on the policy's way and 2 in the widest gaps of the samples agree with the model"
        )


def test_a_model_error_in_a_sample_gap_fails_the_audit_of_a_ready_design(server_process: ServerProcess) -> None:
    """The promise is right: the policy does not go there, perhaps because of what the model has wrong."""
    with placed(server_process.url, SPEC, Slope()) as place:
        place.environment.changed = True
        handover = hand_over(place.subject(), AUDIT)
        assert handover.audit is not None
        assert handover.audit.elsewhere == 2
        assert handover.audit.faults[0].startswith("reward: errors of")
        assert not handover.trusted


def test_an_audit_without_a_sampler_is_given_up(
    pendulum_server: ServerProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(waiting, "FIRST_LEASE_SECONDS", 1.0)
    with Api(pendulum_server.url) as api, HttpSurrogate(pendulum_server.url, "pendulum") as port:
        subject = Subject(api, "pendulum", port, lambda o: np.zeros((len(o), 1)))
        before = api.surrogate("pendulum").queries
        handover = hand_over(subject, AUDIT)
        assert api.surrogate("pendulum").queries == before, "nothing is left in the queue"
    assert handover.audit is None
    assert handover.reason.endswith(NO_SAMPLER)


def test_the_audit_of_a_reset_only_environment_is_a_whole_episode(server_process: ServerProcess) -> None:
    with placed(server_process.url, rail.SPEC, rail.Rail()) as place:
        handover = hand_over(place.subject(), AUDIT)
        assert handover.audit is not None
        assert handover.audit.steps == rail.SPEC.time_limit
        audited = [query for query in place.api.queries(place.name) if query.purpose == "audit"]
        assert [query.kind for query in audited] == ["rollout"]
        assert place.api.surrogate(place.name).ledger.audit == handover.audit.steps


def test_an_audit_by_resets_takes_as_many_rollouts_of_the_policy_as_reach_its_states(
    server_process: ServerProcess,
) -> None:
    """The policy stays where an episode begins, so one rollout reaches few of its states."""
    starts = {"x": Uniform(low=-0.9, high=0.9)}
    spec = rail.SPEC.model_copy(update={"start": starts, "time_limit": 200, "max_rollout": 50})
    stay = Network(np.zeros(1), np.ones(1), (Layer(np.zeros((1, 1)), np.zeros(1)),), -np.ones(1), np.ones(1))
    with placed(server_process.url, spec, Wide()) as place:
        audit = hand_over(replace(place.subject(), predict=stay), AUDIT).audit
        queries = [query for query in place.api.queries(place.name) if query.purpose == "audit"]
    assert audit is not None
    assert audit.rollouts == len(queries)
    assert len(queries) in (2, 4)
    assert all(query.policy for query in queries)
    assert {len(query.actions) for query in queries} == {42 // len(queries)}
    assert audit.steps == len(queries) * (42 // len(queries))
    assert audit.passed, audit.faults
    assert audit.untested < 0.2


@pytest.mark.parametrize(("steps", "longest", "sizes"), [(100, 5, [5] * 8), (8, 5, [5] * 2), (64, 200, [16] * 4)])
def test_an_audit_of_more_steps_or_shorter_rollouts_takes_more_rollouts(
    monkeypatch: pytest.MonkeyPatch, steps: int, longest: int, sizes: list[int]
) -> None:
    """An audit of 100 steps by rollouts of 5 was one rollout, and a longer audit reached fewer starts.

    Each episode of the policy stays at its start, and every second start is the same, so four show all states.
    """
    starts = np.array([-0.9, -0.3, 0.3, 0.9] * 2) if longest > 5 else np.zeros(8)
    ways = [(np.full((200, 1), start), np.zeros((200, 1))) for start in starts]
    monkeypatch.setattr(handover, "ways_of", lambda _subject, _episodes, most: [(q[:most], u[:most]) for q, u in ways])
    spec = rail.SPEC.model_copy(update={"time_limit": 200, "max_rollout": longest})
    subject = Mock()
    subject.api.surrogate.return_value = Mock(budget=10, ledger=Mock(audit=0))
    subject.port.spec.return_value = spec
    states = np.concatenate([q for q, _ in ways]) + np.linspace(0, 0.01, 1_600)[:, None]
    assert [len(actions) for actions in handover._rollouts(subject, steps, states, 200)] == sizes


def test_a_policy_whose_audit_has_no_steps_left_is_handed_over_without_one(server_process: ServerProcess) -> None:
    """A training that had ended with its third audit refused was lost in an error."""
    with placed(server_process.url, rail.SPEC, rail.Rail()) as place:
        for length in (20, 20, 20, 20, 20, 20, 5):
            place.api.add_queries(place.name, rollouts=[[[0.0]] * length], audit=True)
        before = len(place.api.queries(place.name))
        handover = hand_over(place.subject(), AUDIT)
        assert len(place.api.queries(place.name)) == before
    assert handover.audit is None
    assert handover.promise is not None
    assert "at most 3 more real steps of audits, got 8" in handover.reason


class Wide(rail.Rail):
    """The rail, whose episodes begin anywhere."""

    def reset(self, *, seed: int | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.x *= 4.5
        return np.array([self.x, self.x]), {}


class Paying(rail.Rail):
    """The rail, with a reward of 1 - |x|. Once it is changed, every episode ends at its third step."""

    changed = False
    steps = 0

    def reset(self, *, seed: int | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.steps = 0
        return super().reset(seed=seed)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        observation, reward, over, truncated, said = super().step(action)
        self.steps += 1
        return observation, 1 + reward, over or (self.changed and self.steps == 3), truncated, said


@pytest.mark.parametrize("changed", [False, True])
def test_an_audit_by_whole_episodes_checks_dynamics_and_return(server_process: ServerProcess, changed: bool) -> None:
    with placed(server_process.url, rail.SPEC, Paying()) as place:
        real = Paying()
        real.changed = changed
        result = evaluate(
            place.subject().predict, lambda: open_episode("rail", None, lambda: real), EvaluationSettings(3)
        )
        handover = judge_episodes(place.subject(), result)
        assert handover.audit is not None
        assert (handover.audit.episodes, handover.audit.steps) == (3, 9 if changed else 60)
        assert handover.trusted is not changed, handover.reason
        if changed:
            assert handover.reason.startswith("the audit failed: 3 whole episodes earned 2.")


@pytest.mark.parametrize("often", [False, True])
def test_an_audit_in_which_the_fallback_acts_more_often_than_promised_has_failed(
    server_process: ServerProcess, often: bool
) -> None:
    machine = keeping_limits(answering(limited.PatientCart()))
    with placed(server_process.url, limited.SPEC, machine, Design(initial=12, budget=24)) as place:
        subject = replace(place.subject(), predict=lambda shown: np.clip(-shown[:, :1] - shown[:, 1:], -1, 1))
        make = partial(open_episode, "a cart", None, limited.PatientCart)
        result = evaluate(subject.predict, make, EvaluationSettings(3))
        assert result.limits is not None
        assert result.limits.fallback_episodes == 0
        if often:
            result = replace(result, limits=replace(result.limits, fallback_episodes=3, fallbacks=9))
        handover = judge_episodes(subject, result)
        assert handover.audit is not None
        assert handover.audit.passed is not often
        if often:
            assert "in 3 of 3 episodes" in handover.audit.faults[0]
            assert handover.audit.faults[1].startswith("the fallback acted more often than expected")


def test_whole_episodes_are_judged_by_the_reward_with_the_policys_set_points(
    server_process: ServerProcess,
) -> None:
    def to_the_right(observations: np.ndarray) -> np.ndarray:
        return np.clip(10 * (0.3 - observations), -1, 1)

    with placed(server_process.url, DECLARED, Line()) as place:
        aimed = replace(place.subject(), predict=to_the_right, session={"set_points": {"x": 0.3}})
        result = evaluate(to_the_right, lambda: open_episode("a line", DECLARED, Line), EvaluationSettings(3))
        handover = judge_episodes(aimed, result)
        assert handover.trusted, handover.reason
        assert handover.promise is not None
        assert handover.promise.median > result.returns.mean() + 2


def test_whole_episodes_show_a_policy_its_integrals_as_the_model_does(server_process: ServerProcess) -> None:
    def back(observations: np.ndarray) -> np.ndarray:
        assert observations.shape[1] == 2
        return np.clip(-10 * observations[:, :1], -1, 1)

    with placed(server_process.url, DECLARED, Line()) as place:
        port = with_integrals(place.port, ("x",), {})
        subject = replace(place.subject(), predict=back, port=port)
        assert hand_over(subject, AUDIT).trusted

        def opener() -> Episode:
            return open_episode("a line", DECLARED, Line)

        handover = by_episodes(subject, "a line", opener, EvaluationSettings(3), quiet=True)
        assert handover.trusted, handover.reason


class Broken(Changed):
    """The line with a wall on the left, once it is changed."""

    def step_from(self, coordinates: np.ndarray, action: np.ndarray) -> RealStep:
        if self.changed and coordinates[0] < -0.3:
            raise RuntimeError("there is a wall on the left")
        return super().step_from(coordinates, action)


def test_a_policy_is_not_trusted_if_the_environment_failed_at_an_audit_query(server_process: ServerProcess) -> None:
    with placed(server_process.url, SPEC, Broken()) as place:
        place.environment.changed = True
        handover = hand_over(place.subject(), AUDIT)
        assert not handover.trusted
        assert handover.audit is not None
        assert handover.audit.steps + handover.audit.unanswered == 8
        assert handover.reason.endswith(" of 8 queries, so nothing is known there")
        assert place.api.surrogate(place.name).ledger.audit == handover.audit.steps


class Interlocked(rail.Rail):
    """The rail, which once it is changed ends every episode at its third step, or fails at the step ``fails``."""

    changed = False
    fails = 0
    steps = 0

    def reset(self, *, seed: int | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.steps = 0
        return super().reset(seed=seed)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        if self.changed and self.fails == self.steps + 1:
            raise RuntimeError("the interlock is open")
        observation, reward, over, truncated, said = super().step(action)
        self.steps += 1
        return observation, reward, over or (self.changed and not self.fails and self.steps == 3), truncated, said


@pytest.mark.parametrize("fails", [0, 1, 4], ids=["ends", "fails", "stops"])
def test_a_policy_whose_audit_rollout_fails_or_ends_early_is_not_trusted(
    server_process: ServerProcess, fails: int
) -> None:
    """A rollout that failed at its fourth step was taken for one of three steps."""
    with placed(server_process.url, rail.SPEC, Interlocked()) as place:
        place.environment.fails, place.environment.changed = fails, True
        handover = hand_over(place.subject(), AUDIT)
        assert handover.audit is not None
        assert handover.audit.steps == (0 if fails == 1 else 3)
        assert not handover.trusted
        failed = (
            "failed at 1 of 1 queries, so nothing is known there; the last error was: RuntimeError: the interlock is "
        )
        stopped = "1 of 1 rollout stopped after the first steps, because the original environment failed or"
        said = {0: "where the model predicted no end", 1: f"{failed}open", 4: stopped}[fails]
        assert said in handover.reason


class Misplaced(rail.Rail):
    """The rail, whose resets once it is changed lead elsewhere."""

    changed = False

    def reset(self, *, seed: int | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.x -= 0.7 * self.changed
        return np.array([self.x, self.x]), {}


@pytest.mark.parametrize("whole", [False, True], ids=["queries", "episodes"])
def test_a_policy_whose_audit_begins_at_no_declared_start_is_not_trusted(
    server_process: ServerProcess, whole: bool
) -> None:
    with placed(server_process.url, rail.SPEC, Misplaced()) as place:
        place.environment.changed = True
        if whole:
            make = partial(open_episode, "rail", None, lambda: place.environment)
            result = evaluate(place.subject().predict, make, EvaluationSettings(3))
            handover = judge_episodes(place.subject(), result)
        else:
            handover = hand_over(place.subject(), AUDIT)
        assert handover.audit is not None
        assert not handover.trusted
        count = 3 if whole else 1
        assert f"{count} of {count} resets led to no declared start, such as x = -0." in handover.audit.faults[0]
        assert handover.audit.undeclared


@pytest.mark.parametrize("whole", [False, True], ids=["queries", "episodes"])
def test_a_policy_in_whose_audit_an_undeclared_encoder_wraps_is_not_trusted(
    server_process: ServerProcess, whole: bool
) -> None:
    with placed(server_process.url, wheel.SPEC, wheel.Wheel(), wheel.SPEC.design) as place:
        subject = replace(place.subject(), predict=lambda observations: -np.ones((len(observations), 1)))
        if whole:
            make = partial(open_episode, "a wheel", None, wheel.Wheel)
            handover = judge_episodes(subject, evaluate(subject.predict, make, EvaluationSettings(3)))
        else:
            handover = hand_over(subject, AUDIT)
        assert handover.audit is not None
        assert not handover.trusted
        count = 60 if whole else 20
        assert re.match(rf"x jumps by 2048 in [1-9] of {count} steps, as", handover.audit.faults[0])
        assert handover.audit.undeclared


@pytest.mark.parametrize("whole", [False, True], ids=["queries", "episodes"])
def test_a_policy_whose_audit_has_a_late_step_is_not_trusted(server_process: ServerProcess, whole: bool) -> None:
    environment = rail.Timed(machine=True)
    with placed(server_process.url, environment.spec(), environment) as place:
        environment.late = 0.5
        if whole:
            make = partial(open_episode, "rail", None, lambda: environment)
            result = evaluate(place.subject().predict, make, EvaluationSettings(3))
            handover = judge_episodes(place.subject(), result)
        else:
            handover = hand_over(place.subject(), AUDIT)
        assert handover.audit is not None
        assert not handover.trusted
        count = 57 if whole else 19
        assert re.match(
            rf"\d+ of {count} intervals between steps are off .* such as 0\.[6-9]", handover.audit.faults[0]
        )
        assert handover.audit.undeclared


class Growing(Line):
    """x doubles in each step, and is paid by its square. In 20 steps that is 1e10; a model of [-1, 1] imagines 30."""

    def step_from(self, coordinates: np.ndarray, action: np.ndarray) -> RealStep:
        x = float(coordinates[0])
        return RealStep(coordinates, action, [2 * x + 0.1 * float(action[0])], reward=x**2)


def test_a_policy_that_leaves_the_sampling_range_is_not_trusted(server_process: ServerProcess) -> None:
    with placed(server_process.url, SPEC, Growing()) as place:
        handover = hand_over(place.subject(), AUDIT)
        assert handover.audit is not None
        assert handover.audit.passed, "where it can be audited, the model is right"
        assert not handover.trusted
        assert "beyond what the original environment can be set to" in handover.reason


def test_the_audited_states_are_those_the_policy_visits_in_the_surrogate(line: Place) -> None:
    q, u = way_of(line.subject(), 4, 20)
    assert q.shape == (80, 1)
    assert np.abs(u).max() <= 1
    moved = q[4:, 0] - q[:-4, 0]
    assert moved == pytest.approx(0.1 * u[:-4, 0], abs=0.05)


def test_the_result_of_a_training_contains_a_failed_audit(line: Place, tmp_path: Path) -> None:
    line.environment.changed = True
    line.api.patch_surrogate(line.name, budget=line.api.surrogate(line.name).ledger.total)
    settings = TrainSettings(algorithm="CMAES", total_steps=2_000)
    training = AuditedTraining(line.api, line.name, line.port, tmp_path / "p.zip", settings, audit=AUDIT)
    result, handover = training.train()
    assert result.path.exists()
    assert not handover.trusted
    assert line.api.surrogate(line.name).ledger.audit == 8, "no budget is left to learn more"


@pytest.mark.parametrize("own", [True, False], ids=["its own surrogate", "another surrogate"])
def test_the_audit_command_stores_its_result_in_the_policy_description(
    line: Place, tmp_path: Path, capsys: pytest.CaptureFixture[str], server_process: ServerProcess, own: bool
) -> None:
    """In another surrogate the card's gain over an untrained policy is worth nothing: this policy does nothing."""
    policy, spec = tmp_path / "p.zip", line.port.spec()
    Network.of(spec, np.zeros(1), np.ones(1), 2, np.zeros(Network.size(spec, 2))).save(policy)
    known = {"untrained": -1e3, "imagined_return": 7.0}
    write_card(policy, PolicyCard(algorithm="CMAES", surrogate=line.name if own else "another", **known))
    with pytest.raises(SystemExit) as ended:
        main(["audit", str(policy), "--steps", "4", "--surrogate", line.name, "--json", "--server", server_process.url])
    assert ended.value.code == 0
    said, card = json.loads(capsys.readouterr().out), read_card(policy)
    assert card.surrogate == line.name
    assert (card.untrained, card.imagined_return) == ((-1e3, 7.0) if own else (None, None))
    assert said["trusted"] is card.trusted is own
    assert card.audit is not None
    assert said["audit"]["steps"] == card.audit.steps == line.api.surrogate(line.name).ledger.audit == 4
