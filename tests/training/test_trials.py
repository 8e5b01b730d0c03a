"""Learning by trying over a real server: policies run at the machine, and the model learns from their steps."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from uuid import uuid4

import numpy as np
import pytest

from support.server import ServerProcess, running_server
from surrogym_client.surrogates.waiting import DesignUnfinished, wait_for_design
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_sampler.original.classic import pendulum
from surrogym_sampler.original.rollouts import answering, keeping_limits
from surrogym_sampler.queries import Sampler, SamplerSettings
from surrogym_shared.integrals import Error
from surrogym_shared.limits import past
from surrogym_shared.network import Network
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    Design,
    EnvironmentSpec,
    Limit,
    Limits,
    ObservationEntry,
    Term,
    Uniform,
    with_history,
)
from surrogym_shared.terms import observe
from surrogym_shared.wire import Trial
from surrogym_trainer.policies.files import load_network
from surrogym_trainer.policies.integrals import IntegralPort
from surrogym_trainer.training import TrainSettings, closed_loop
from surrogym_trainer.training.audited import AuditedTraining
from surrogym_trainer.training.closed_loop import LoopSettings
from surrogym_trainer.training.handover import COMPARING, PROMISING, AuditSettings, Subject, hand_over
from surrogym_trainer.training.settings import TrainingInterrupted, TrainResult
from surrogym_trainer.training.trials import Trials, allows_trials, encoded, is_waiting_for_trials
from surrogym_trainer.training.words import words_of_result

BUDGET, FIRST, EPISODE = 110, 70, 15
SETTINGS = TrainSettings(algorithm="FASTPPO", total_steps=4_096, num_envs=16, seed=0)


class Late:
    """A level in [-2, 2] that an action moves after a dead time of one step. It is to stay at 0."""

    parallel = True

    def spec(self) -> EnvironmentSpec:
        plain = EnvironmentSpec(
            environment="late",
            coordinates=(Coordinate(name="level", sampling=Uniform(low=-2, high=2)),),
            observation=(ObservationEntry(name="level", term=Term.linear(level=1)),),
            action=BoxAction(low=(-1,), high=(1,)),
            start={"level": Uniform(low=-1.5, high=1.5)},
            time_limit=EPISODE,
            query="rollout",
            tolerances={"level": 1e-9},
            design=Design(budget=BUDGET, initial=FIRST, seed=0),
        )
        return with_history(plain, changes=4, actions=1, largest={"level": 0.5})  # too many for a planner

    def reset(self, *, seed=None):
        self.level, self.late = float(np.random.default_rng(seed).uniform(-1.5, 1.5)), 0.0
        return self.level, {}

    def step(self, action):
        reward = -(self.level**2)
        self.level, self.late = 0.95 * self.level + 0.2 * np.sin(self.late), float(action[0])
        return self.level, reward, False, False, {}

    def coordinates(self, observation):
        return [observation]

    def close(self):
        pass


class Edged(Late):
    """The same level between edges that it must not pass."""

    def spec(self) -> EnvironmentSpec:
        edges = Limit(name="edges", term=Term.linear(level=1), low=-1.9, high=1.9, margin=0.3)
        limits = Limits(keep=(edges,), fallback=(Term.linear(level=-1),))
        own = super().spec()
        start = {**own.start, "level": Uniform(low=1.0, high=1.5)}
        changes = {"limits": limits.model_dump(), "sampling_period": 0.1, "start": start}
        return EnvironmentSpec.model_validate({**own.model_dump(), **changes})

    def reset(self, *, seed=None):
        super().reset(seed=seed)
        self.level = 1.25 + self.level / 6
        return self.level, {}


class Planned(Late):
    """The same level, with earlier actions alone as further coordinates, so that a planner can steer it."""

    def spec(self) -> EnvironmentSpec:
        plain = super().spec()
        own = {name: getattr(plain, name) for name in EnvironmentSpec.model_fields}
        lags = {"coordinates": plain.coordinates[:1], "observation": plain.observation[:1]}
        start, design = {"level": plain.start["level"]}, Design(budget=30, initial=15, seed=0)
        return with_history(EnvironmentSpec(**own | lags | {"start": start, "design": design}), actions=4)


@pytest.fixture(scope="module")
def trials_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    with running_server(tmp_path_factory.mktemp("trials")) as server:
        yield server


@pytest.fixture
def waiting(trials_server: ServerProcess, request: pytest.FixtureRequest) -> Iterator[str]:
    """A surrogate whose design has left the rest of its budget to trials, with a sampler in a thread. The parameter is
    its environment, by default ``Late``."""
    name, made = f"late-{uuid4().hex[:8]}", getattr(request, "param", Late)
    with Api(trials_server.url) as api, Api(trials_server.url) as own:
        api.create_surrogate(name, made().spec())
        sampler = Sampler(
            own, name, keeping_limits(answering(made())), SamplerSettings(name="thread", wait_seconds=0.5)
        )
        thread = threading.Thread(target=sampler.run)
        thread.start()
        try:
            wait_for_design(api, name, 120)
            yield name
        finally:
            sampler.stop()
            thread.join()
            api.delete_surrogate(name)


def test_policies_try_episodes_with_what_the_design_has_left_of_its_budget(
    trials_server: ServerProcess, waiting: str, tmp_path: Path
) -> None:
    with Api(trials_server.url) as api, HttpSurrogate(trials_server.url, waiting) as port:
        before = api.surrogate(waiting)
        assert before.phase == "unsure"
        assert FIRST <= before.ledger.total < BUDGET
        assert is_waiting_for_trials(api, waiting)
        rounds, audit = LoopSettings(queries=0), AuditSettings()
        training = AuditedTraining(api, waiting, port, tmp_path / "p.zip", SETTINGS, rounds, audit)
        result, handover = training.train()
        after, asked = api.surrogate(waiting), [query for query in api.queries(waiting) if query.policy]
        trials = [query for query in asked if query.purpose == "adaptive"]
        samples = [sample for sample in api.samples(waiting) if sample.query_id == trials[0].id]
    assert 1 <= len(trials) <= 1 + (BUDGET - before.ledger.total) // EPISODE
    assert [len(query.actions) for query in trials[:-1]] == [EPISODE] * (len(trials) - 1)
    assert {query.purpose for query in asked} == {"adaptive", "audit"}, "an audit lets the policy act, too"
    assert handover.audit is not None
    assert after.ledger.audit >= EPISODE
    assert after.ledger.total <= BUDGET == after.budget
    assert len({tuple(sample.action) for sample in samples}) > 1
    assert result.virtual_steps > SETTINGS.total_steps
    load_network(result.path)


@pytest.mark.parametrize(("left", "trials"), [(45, 3), (40, 3), (33, 2), (3, 0), (10_000, 20)])
def test_the_expected_number_of_trials_follows_from_the_budget(tmp_path: Path, left: int, trials: int) -> None:
    api = SimpleNamespace(surrogate=lambda _: SimpleNamespace(budget_left=left))
    port = SimpleNamespace(spec=Late().spec)
    some = Trials(api, "late", port, tmp_path / "p.zip", SETTINGS, LoopSettings(queries=0))  # type: ignore[arg-type]
    assert some._trials_left(0) == trials


def test_a_number_of_rounds_and_of_steps_raises_the_budget(
    trials_server: ServerProcess, waiting: str, tmp_path: Path
) -> None:
    with Api(trials_server.url) as api, HttpSurrogate(trials_server.url, waiting) as port:
        rounds = LoopSettings(queries=100, rounds=3)
        trials = Trials(api, waiting, port, tmp_path / "p.zip", SETTINGS, rounds)
        trials._confirms = lambda *_: False  # no trial is the last one
        result = trials.train()
        view, asked = api.surrogate(waiting), [query for query in api.queries(waiting) if query.policy]
    assert [len(query.actions) for query in asked] == [EPISODE] * 3, "a trial is at most an episode"
    assert view.ledger.total == view.budget > BUDGET
    assert len(trials.trained) == 4
    assert result.virtual_steps == sum(one.virtual_steps for one in trials.trained)


@pytest.mark.parametrize(("phase", "tries"), [("ready", False), ("unsure", True), ("over_budget", True)])
def test_rounds_of_a_ready_design_take_no_trial(tmp_path: Path, phase: str, tries: bool) -> None:
    api, port = SimpleNamespace(surrogate=lambda _: SimpleNamespace(phase=phase)), SimpleNamespace(spec=Late().spec)
    rounds = LoopSettings(queries=EPISODE)
    training = AuditedTraining(api, "late", port, tmp_path / "p.zip", SETTINGS, rounds)  # type: ignore[arg-type]
    assert training._may_try(rounds) is tries


def test_a_policy_that_sees_an_integral_acts_in_audits(trials_server: ServerProcess, waiting: str) -> None:
    with Api(trials_server.url) as api, HttpSurrogate(trials_server.url, waiting) as own:
        port = IntegralPort(own, (Error("level", 0.0, 2.0),))
        size = len(port.spec().observation)
        weights = np.random.default_rng(0).normal(size=Network.size(port.spec(), 4))
        policy = Network.of(port.spec(), np.zeros(size), np.ones(size), 4, weights)
        handover = hand_over(Subject(api, waiting, port, policy), AuditSettings())
        assert handover.audit is not None
        assert handover.audit.steps >= 8
        audited = [query.id for query in api.queries(waiting) if query.policy]
        rollouts = [[sample for sample in api.samples(waiting) if sample.query_id == number] for number in audited]
    assert rollouts
    for samples in rollouts:
        states = np.array([sample.coordinates for sample in samples])
        levels = states[:, :1]
        sums = np.zeros_like(levels)
        for now in range(1, len(sums)):
            sums[now] = np.clip(sums[now - 1] + levels[now] / 2.0, -1, 1)
        assert np.ptp(sums) > 0.1
        chosen = policy(np.concatenate([observe(Late().spec(), states), sums], axis=1))
        assert [sample.action for sample in samples] == [pytest.approx(action, abs=1e-6) for action in chosen.tolist()]


@pytest.mark.parametrize("waiting", [Planned], indirect=True)
def test_a_machine_with_a_dead_time_gets_a_planner_that_acts_in_its_audit(
    trials_server: ServerProcess, waiting: str, tmp_path: Path
) -> None:
    with Api(trials_server.url) as api, HttpSurrogate(trials_server.url, waiting) as port:
        said: list[str] = []
        audit, out = AuditSettings(), tmp_path / "p.zip"
        training = AuditedTraining(api, waiting, port, out, TrainSettings(), audit=audit, saying=said.append)
        result, handover = training.train()
        view = api.surrogate(waiting)
        queries = [query for query in api.queries(waiting) if query.purpose == "audit"]
        samples = [sample for sample in api.samples(waiting) if sample.query_id == queries[0].id]
    assert result.algorithm == "PLANNER"
    named = [words for words in said if "%" not in words]
    assert named == [PROMISING, COMPARING, PROMISING], "a planner's virtual episodes may take minutes"
    shares = [words.removeprefix(f"{PROMISING}: ") for words in said if words.startswith(f"{PROMISING}: ")]
    assert len(shares) == 2 * min(EPISODE, 100), "of the steps of both promises' episodes"
    assert f"{COMPARING}: 100 %" in said
    assert shares[-1] == "100 %"
    assert view.phase == "over_budget", "nothing of the budget is left to trials"
    assert handover.audit is not None
    assert handover.audit.passed
    assert all(query.replan for query in queries)
    assert len(samples) == len(queries[0].actions)
    assert handover.audit.steps == sum(len(query.actions) for query in queries)
    taken = np.array([sample.action for sample in samples])
    assert not np.array_equal(taken, np.array(queries[0].actions)), "planned from what was measured"


@pytest.mark.parametrize(
    ("settings", "allowed"),
    [
        (SETTINGS, True),
        (TrainSettings(algorithm="CMAES"), True),
        (TrainSettings(algorithm="SAC"), False),
        (replace(SETTINGS, integral=("level",)), True),
    ],
)
def test_trials_need_a_search_whose_policies_are_networks_of_arrays(settings: TrainSettings, allowed: bool) -> None:
    assert allows_trials(Late().spec(), settings) is allowed


def test_no_trial_is_taken_where_any_state_can_be_set_or_a_planner_can_act() -> None:
    assert not allows_trials(pendulum(), SETTINGS)
    assert not allows_trials(pendulum().model_copy(update={"query": "rollout"}), SETTINGS)


def test_ctrl_c_during_a_trial_leaves_the_best_policy_so_far(
    trials_server: ServerProcess, waiting: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> bool:
        raise KeyboardInterrupt

    with Api(trials_server.url) as api, HttpSurrogate(trials_server.url, waiting) as port:
        trials = Trials(api, waiting, port, tmp_path / "p.zip", SETTINGS, LoopSettings(queries=0))
        monkeypatch.setattr(trials, "_try", interrupted)
        with pytest.raises(TrainingInterrupted) as stopped:
            trials.train()
    assert stopped.value.result.virtual_steps == trials.trained[0].virtual_steps
    load_network(tmp_path / "p.zip")


def test_ctrl_c_during_a_later_training_leaves_a_better_earlier_policy(
    trials_server: ServerProcess, waiting: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The later network is a new one, and has learned nothing yet."""

    def cut_off(port: object, out: Path, settings: TrainSettings, *_: object) -> TrainResult:
        network, result = idle(-1.0), trials.trained[0]
        network.save(out)
        raise TrainingInterrupted(replace(result, virtual_steps=1))

    path = tmp_path / "p.zip"
    with Api(trials_server.url) as api, HttpSurrogate(trials_server.url, waiting) as port:
        trials = Trials(api, waiting, port, path, SETTINGS, LoopSettings(queries=0))
        learned = trials._learn(0, longer=False)
        content = path.read_bytes()
        monkeypatch.setattr(closed_loop, "train", cut_off)
        monkeypatch.setattr(trials, "_run", lambda: trials._learn(1, longer=False))
        with pytest.raises(TrainingInterrupted) as stopped:
            trials.train()
    assert path.read_bytes() == content
    assert stopped.value.result.virtual_steps == learned.virtual_steps + 1


@pytest.fixture
def trials(trials_server: ServerProcess, waiting: str, tmp_path: Path) -> Iterator[Trials]:
    with Api(trials_server.url) as api, HttpSurrogate(trials_server.url, waiting) as port:
        yield Trials(api, waiting, port, tmp_path / "p.zip", SETTINGS, LoopSettings(queries=0))


def idle(push: float = 0.0) -> Network:
    """A policy whose action is always ``push``."""
    spec = Late().spec()
    size, weights = len(spec.observation), np.zeros(Network.size(spec, 4))
    weights[-1] = push
    return Network.of(spec, np.zeros(size), np.ones(size), 4, weights)


@pytest.mark.parametrize("waiting", [Edged], indirect=True)
def test_the_sampler_keeps_declared_limits_in_the_trial_of_a_policy_that_pushes_against_them(
    trials: Trials, waiting: str
) -> None:
    before = trials.api.surrogate(waiting)
    assert (before.phase, before.budget_left > 0) == ("unsure", True)
    assert allows_trials(before.spec, SETTINGS)
    assert trials._try(idle(1.0), EPISODE, 0) is True
    tried = list(trials.api.samples(waiting))[before.samples :]
    reached = np.array([sample.next_coordinates for sample in tried])
    assert len(tried) == EPISODE
    assert not past(before.spec, reached).any()
    assert {sample.action[0] > 0 for sample in tried} == {True, False}, "the fallback acted"


def test_a_trial_that_a_failed_step_cut_off_has_not_succeeded(
    trials: Trials, waiting: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert trials._try(idle(), EPISODE, 0) is True
    step, numbers = Late.step, iter(range(EPISODE))
    faulty = lambda late, action: 1 / 0 if next(numbers) == 5 else step(late, action)  # noqa: E731
    monkeypatch.setattr(Late, "step", faulty)
    assert trials._try(idle(), EPISODE, 1) is False
    cut = max(query.id for query in trials.api.queries(waiting))
    assert len([sample for sample in trials.api.samples(waiting) if sample.query_id == cut]) == 5


def test_trials_end_with_the_best_policy_if_the_machine_takes_no_first_step(
    trials: Trials, waiting: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Late, "step", lambda *_: 1 / 0)
    result = trials.train()
    (failed,) = [query for query in trials.api.queries(waiting) if query.policy]
    assert (failed.status, len(trials.trained)) == ("set_aside", 1)
    assert "; 1 round;" in words_of_result(result)
    load_network(result.path)


def test_trials_without_a_sampler_end_with_an_error_that_names_the_policy(
    trials: Trials, monkeypatch: pytest.MonkeyPatch
) -> None:
    going = threading.Event()
    step = Late.step
    monkeypatch.setattr(Late, "step", lambda *arguments: going.wait(60) and step(*arguments))
    trials.rounds = LoopSettings(queries=0, patience_seconds=1.0)
    try:
        with pytest.raises(DesignUnfinished, match=r"has not ended after 1 s.*the policy so far is in .*p\.zip"):
            trials.train()
    finally:
        going.set()


def test_a_training_waits_for_trials_while_the_machine_takes_that_of_another_training(
    trials: Trials, waiting: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    going = threading.Event()
    step = Late.step
    monkeypatch.setattr(Late, "step", lambda *arguments: going.wait(60) and step(*arguments))
    try:
        trials.api.improve(waiting, trial=Trial(policy=encoded(idle(), trials.port), actions=[[0.0]] * 3))
        assert trials.api.surrogate(waiting).phase == "sampling"
        assert is_waiting_for_trials(trials.api, waiting)
    finally:
        going.set()


def test_a_training_judges_its_own_trial_beside_that_of_another_training(
    trials: Trials, waiting: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def beside(*_: object) -> list[list[float]]:
        trials.api.improve(waiting, trial=Trial(policy=encoded(idle(), trials.port), actions=[[0.5]]))
        return [[0.25]] * EPISODE

    judged: list[int] = []
    monkeypatch.setattr("surrogym_trainer.training.trials.expected_actions", beside)
    monkeypatch.setattr(
        "surrogym_trainer.training.trials.succeeded", lambda _, states, *__, **___: not judged.append(len(states))
    )
    assert trials._try(idle(), EPISODE, 0)
    assert judged == [EPISODE]


def test_an_interrupted_training_withdraws_a_trial_that_no_sampler_has_begun(
    trials: Trials, waiting: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        assert trials.api.surrogate(waiting).queries.pending == 1
        raise KeyboardInterrupt

    before = trials.api.patch_surrogate(waiting, paused=True)  # so that the sampler does not begin the trial
    monkeypatch.setattr("surrogym_trainer.training.trials.wait_for_design", interrupted)
    with pytest.raises(TrainingInterrupted):
        trials.train()
    trials.api.patch_surrogate(waiting, paused=False)
    after = wait_for_design(trials.api, waiting, 60)
    assert (after.phase, after.ledger, after.budget_left) == ("unsure", before.ledger, before.budget_left)
    assert not [query for query in trials.api.queries(waiting) if query.policy]


def test_trials_end_if_their_query_is_withdrawn_meanwhile(
    trials: Trials, waiting: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def changed(*arguments: Any, **after: Any) -> None:
        trials.api.withdraw_audit(waiting, [query.id for query in trials.api.queries(waiting)])
        trials.api.patch_surrogate(waiting, paused=False)
        wait_for_design(*arguments, **after)

    trials.api.patch_surrogate(waiting, paused=True)
    monkeypatch.setattr("surrogym_trainer.training.trials.wait_for_design", changed)
    assert trials._try(idle(), EPISODE, 0) is None
