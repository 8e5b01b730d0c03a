"""Rollouts against a real server: every real step taken is a sample, whatever ends the rollout."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import uuid
from base64 import b64encode
from itertools import pairwise

import numpy as np
import pytest

from support import wheel
from support.rail import SPEC, HangsRight, Rail, RaisesRight, Timed
from surrogym_client.errors import InvalidInput
from surrogym_sampler import original
from surrogym_sampler.original.errors import UnknownEnvironment
from surrogym_sampler.original.isolated import IsolatedEnvironment
from surrogym_sampler.queries import Sampler, SamplerSettings
from surrogym_sampler.queries.acting import following, replanning
from surrogym_sampler.queries.sample_conversion import reset_seed
from surrogym_sampler.queries.words import line_of, words_of_query
from surrogym_shared.network import Layer, Network
from surrogym_shared.terms import observe
from surrogym_shared.wire import NewSample, RolloutQuery, Trial

RIGHT, LEFT = [1.0], [-1.0]
ONE = SamplerSettings(name="worker", batch=1, once=True, wait_seconds=5.0)
KILLED = """
import sys
from support.rail import Slow
from surrogym_client.transport import Api
from surrogym_sampler.queries import Sampler, SamplerSettings

with Api(sys.argv[1]) as api:
    Sampler(api, sys.argv[2], Slow(), SamplerSettings(name="killed", batch=1, lease_seconds=3.0, once=True)).run()
"""


@pytest.fixture
def rail(api):
    name = f"rail-{uuid.uuid4().hex[:8]}"
    api.create_surrogate(name, SPEC)
    yield name
    api.delete_surrogate(name)


@pytest.fixture
def asked(api, rail):
    """A surrogate whose only open query is one rollout: twice to the left, once to the right, once to the left."""
    for query in api.claim(rail, "nobody", max_queries=100).queries:
        for _ in range(3):
            api.fail(rail, query.id, query.lease_token, "not today")
            again = api.claim(rail, "nobody", max_queries=1).queries
            query = again[0] if again else query
    api.add_queries(rail, rollouts=[[LEFT, LEFT, RIGHT, LEFT]])
    return rail


def test_a_sampler_answers_a_rollout_design_by_resets_and_action_sequences(api, rail):
    with IsolatedEnvironment(Rail) as environment:
        report = Sampler(api, rail, environment, SamplerSettings(until_done=True, time_limit=90.0)).run()
    view, samples = api.surrogate(rail), list(api.samples(rail))
    assert report.phase == view.phase
    assert view.phase in ("ready", "over_budget")
    assert report.steps == len(samples) == view.ledger.total <= 10
    assert view.ledger.initial == 6
    trajectories: dict[int, list] = {}
    for sample in samples:
        trajectories.setdefault(sample.trajectory, []).append(sample)
    assert report.answered == len(trajectories) == view.queries.answered
    for steps in trajectories.values():
        assert [sample.step for sample in steps] == list(range(len(steps)))
        assert all(before.next_coordinates == after.coordinates for before, after in pairwise(steps))


def test_rollouts_from_resets_are_claimed_one_by_one(api, asked):
    """Ctrl-C of an audit left four rollouts, which a sampler had claimed, to the machine."""
    api.add_queries(asked, rollouts=[[LEFT]])
    settings = SamplerSettings(name="worker", batch=4, once=True, wait_seconds=5.0)
    assert Sampler(api, asked, Rail(), settings).run().answered == 1
    queries = api.surrogate(asked).queries
    assert (queries.pending, queries.leased) == (1, 0)


class Elsewhere(Rail):
    """A rail whose reset leaves the wagon far to the left."""

    def reset(self, *, seed=None):
        super().reset(seed=seed)
        self.x -= 0.7
        return np.array([self.x, self.x]), {}


def test_a_reset_that_misses_the_declared_start_is_said_with_its_value_and_its_steps_are_learned(api, asked):
    told = []
    Sampler(api, asked, Elsewhere(), ONE, lambda _, *said: told.append(said)).run()
    ((outcome, remark),) = told
    assert outcome == "answered"
    x = list(api.samples(asked))[-4].coordinates[0]
    assert remark == (
        f"1 of 1 resets led to no declared start, such as x = {x:.4g}, where the specification declares -0.2 to 0.2"
    )


def test_a_coordinate_that_wraps_is_said_with_its_jump_and_its_steps_are_learned(api):
    told, name = [], f"wheel-{uuid.uuid4().hex[:8]}"
    api.create_surrogate(name, wheel.SPEC)
    api.add_queries(name, rollouts=[[[1.0]] * 20, [[-1.0]] * 20])
    settings = SamplerSettings(name="worker", until_done=True, time_limit=60.0)
    Sampler(api, name, wheel.Wheel(), settings, lambda query, *said: told.append((query.purpose, *said))).run()
    remarks = [remark for purpose, outcome, remark in told if purpose == "manual" and outcome == "answered"]
    assert len(remarks) == 2
    assert all(
        re.fullmatch(
            r"x jumps by 2048 in [12] of 20 steps, as an angle or a clock in counts does: multiply it by 2 pi / 2048, "
            r"and declare it as an angle",
            remark,
        )
        for remark in remarks
    )
    assert sum(abs(s.next_coordinates[0] - s.coordinates[0]) > 1024 for s in api.samples(name)) >= 2
    api.delete_surrogate(name)


@pytest.mark.parametrize("machine", [True, False], ids=["machine", "simulator"])
def test_a_step_that_comes_late_is_said_of_a_machine_but_not_of_a_simulator(api, machine):
    told, name, environment = [], f"timed-{uuid.uuid4().hex[:8]}", Timed(machine, late=0.5)
    api.create_surrogate(name, environment.spec())
    api.add_queries(name, rollouts=[[LEFT] * 12])
    settings = SamplerSettings(name="worker", until_done=True, time_limit=60.0)
    Sampler(api, name, environment, settings, lambda query, *said: told.append((query.purpose, *said))).run()
    (remark,) = (remark for purpose, _, remark in told if purpose == "manual")
    seconds = [sample.seconds for sample in api.samples(name) if sample.purpose == "manual"]
    assert seconds[0] is None
    assert len(seconds) == 12, "nothing is lost"
    assert max(seconds[1:]) == seconds[6] >= 0.5
    if machine:
        assert re.fullmatch(
            rf"\d+ of 11 intervals between steps are off by half of the sampling period or more, such as "
            rf"{seconds[6]:.3g} s, where the specification declares 0.1 s",
            remark,
        )
    else:
        assert remark == ""
    api.delete_surrogate(name)


def test_a_step_that_comes_late_in_a_short_rollout_is_said_once_earlier_ones_show_the_clock(api):
    told, name, environment = [], f"timed-{uuid.uuid4().hex[:8]}", Timed(True, late=0.5, at=3)
    api.create_surrogate(name, environment.spec())
    api.add_queries(name, rollouts=[[LEFT] * 4] * 3)
    settings = SamplerSettings(name="worker", until_done=True, time_limit=60.0)
    Sampler(api, name, environment, settings, lambda query, *said: told.append((query.purpose, *said))).run()
    *_, last = (remark for purpose, _, remark in told if purpose == "manual")
    assert re.match(r"[12] of 3 intervals between steps are off by half of the sampling period or more", last)
    api.delete_surrogate(name)


def test_a_known_simulator_is_not_timed(api):
    environment, name = original.make("Pendulum-v1", access="reset", budget=4, initial=4), f"p-{uuid.uuid4().hex[:8]}"
    api.create_surrogate(name, environment.spec())
    Sampler(api, name, environment, SamplerSettings(max_queries=1, wait_seconds=5.0, time_limit=60.0)).run()
    assert all(sample.seconds is None for sample in api.samples(name))
    api.delete_surrogate(name)


def test_a_rollout_that_terminates_early_returns_its_unused_budget(api, rail):
    api.add_queries(rail, rollouts=[[RIGHT] * 20])
    Sampler(api, rail, Rail(), SamplerSettings(max_queries=4, wait_seconds=5.0, time_limit=60.0)).run()
    last = list(api.samples(rail))[-1]
    assert last.terminated
    assert last.step < 13
    assert api.surrogate(rail).ledger.manual == last.step + 1


def test_a_rollout_that_fails_midway_submits_the_steps_before_the_failure(api, asked):
    told = []
    report = Sampler(api, asked, RaisesRight(), ONE, lambda *seen: told.append(seen)).run()
    assert (report.answered, report.failed, report.steps) == (1, 0, 2)
    assert [(outcome, error) for _, outcome, error in told] == [("answered", "RuntimeError: the rail is blocked")]
    assert api.queries(asked)[-1].status == "answered"
    assert api.surrogate(asked).ledger.manual == 2


def test_a_rollout_that_hangs_midway_is_killed_and_submits_earlier_steps(api, asked):
    with IsolatedEnvironment(HangsRight, step_limit=0.5) as environment:
        assert Sampler(api, asked, environment, ONE).run().steps == 2
    assert api.surrogate(asked).ledger.manual == 2


def test_a_rollout_that_fails_at_the_first_step_fails_its_query(api, asked):
    api.add_queries(asked, rollouts=[[RIGHT, LEFT]])
    settings = SamplerSettings(name="worker", max_queries=2, batch=1, wait_seconds=5.0)
    report = Sampler(api, asked, RaisesRight(), settings).run()
    assert (report.answered, report.failed, report.steps) == (1, 1, 2)
    assert "the rail is blocked" in api.queries(asked)[-1].error


def test_a_stopped_rollout_submits_its_finished_steps(api, asked):
    class Stops(Rail):
        def step(self, action):
            sampler.stop()
            return super().step(action)

    sampler = Sampler(api, asked, Stops(), ONE)
    assert (sampler.run().steps, api.surrogate(asked).ledger.manual) == (1, 1)


def test_an_interrupted_rollout_submits_its_finished_steps(api, asked):
    class Interrupted(Rail):
        def step(self, action):
            if action[0] > 0:
                raise KeyboardInterrupt
            return super().step(action)

    with pytest.raises(KeyboardInterrupt):
        Sampler(api, asked, Interrupted(), ONE).run()
    assert api.surrogate(asked).ledger.manual == 2
    assert api.queries(asked)[-1].status == "answered"


def test_the_rollout_of_a_killed_sampler_counts_fully_and_is_repeated_by_the_next(api, server_process, asked):
    command = [sys.executable, "-c", KILLED, server_process.url, asked]
    paths = os.pathsep.join(path for path in sys.path if path)
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": paths}) as killed:
        _until(lambda: api.surrogate(asked).queries.leased == 1)
        time.sleep(1.5)  # in the middle of the second of its four steps
        killed.send_signal(signal.SIGKILL)
    settings = SamplerSettings(name="next", batch=1, once=True, wait_seconds=30.0)
    report = Sampler(api, asked, Rail(), settings).run()
    ledger, samples = api.surrogate(asked).ledger, list(api.samples(asked))
    assert report.steps == 4
    expired = ledger.unresolved - ledger.failed  # the design's queries failed before
    assert (ledger.manual, expired) == (4, 4)
    assert {(s.sampler, s.attempt, s.late) for s in samples} == {("next", 2, False)}


def test_a_sampler_asleep_beyond_its_lease_stops_its_rollout_and_submits_its_steps(api, server_process, asked):
    command = [sys.executable, "-c", KILLED, server_process.url, asked]
    paths = os.pathsep.join(path for path in sys.path if path)
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": paths}) as slept:
        _until(lambda: api.surrogate(asked).queries.leased == 1)
        time.sleep(1.5)  # in the middle of the second of its four steps
        slept.send_signal(signal.SIGSTOP)
        settings = SamplerSettings(name="next", batch=1, once=True, wait_seconds=30.0)
        assert Sampler(api, asked, Rail(), settings).run().steps == 4
        slept.send_signal(signal.SIGCONT)
        assert slept.wait(60) == 0
    late = [(sample.step, sample.attempt) for sample in api.samples(asked) if sample.late]
    assert late == [(step, 1) for step in range(len(late))]
    assert len(late) < 4, "the step that was under way is finished, and no other one begun"
    assert api.surrogate(asked).ledger.manual == 4 + len(late)


def _until(happened):
    deadline = time.monotonic() + 60
    while not happened():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.05)


def test_a_rollout_with_a_jump_or_steps_after_termination_is_refused(api, asked):
    [query] = api.claim(asked, "worker", max_queries=1).queries
    values = {"query_id": query.id, "lease_token": query.lease_token, "action": LEFT, "reward": 0.0}

    def step(number, x, x_next, terminated=False):
        return NewSample(**values, step=number, coordinates=[x], next_coordinates=[x_next], terminated=terminated)

    expected = r"samples.1.coordinates: expected \[0.1\], where step 0 of the same query ended, got \[0.2\]"
    with pytest.raises(InvalidInput, match=expected):
        api.add_samples(asked, "worker", [step(0, 0.0, 0.1), step(1, 0.2, 0.3)])
    with pytest.raises(InvalidInput, match="after the end of the episode in step 0"):
        api.add_samples(asked, "worker", [step(0, 0.0, 0.1, True), step(1, 0.1, 0.2)])
    with pytest.raises(InvalidInput, match="at most 4"):
        api.add_samples(asked, "worker", [step(i, float(i), i + 1.0) for i in range(5)])
    assert api.surrogate(asked).ledger.total == 0
    assert len(api.add_samples(asked, "worker", [step(0, 0.0, 0.1), step(1, 0.1, 0.2)]).sample_ids) == 2


def test_a_rollout_query_of_wrong_kind_or_length_is_refused(api, rail):
    with pytest.raises(InvalidInput, match="can't be set to a state"):
        api.add_queries(rail, [[0.0]], [[0.0]])
    with pytest.raises(InvalidInput, match="at most 20 actions in a rollout, got 21"):
        api.add_queries(rail, rollouts=[[LEFT] * 21])
    with pytest.raises(InvalidInput, match=r"entry 0 in \[-1, 1\], got 3"):
        api.add_queries(rail, rollouts=[[LEFT], [[3.0]]])


def test_a_rollout_design_refuses_an_environment_declared_with_settable_states(api, rail):
    from support.moody import Line

    with pytest.raises(UnknownEnvironment, match=r"access to resets alone, got .* access to any state"):
        Sampler(api, rail, Line()).run()


def test_rollout_reset_seeds_depend_on_query_and_design_and_are_reproducible(api, rail):
    queries = api.claim(rail, "worker", max_queries=3).queries
    seeds = {reset_seed(query, design) for query in queries for design in (0, 1)}
    assert len(seeds) == 2 * len(queries)
    assert reset_seed(queries[0], 0) == reset_seed(queries[0].model_copy(update={"lease_token": "other"}), 0)


def test_two_equal_rollout_designs_take_the_same_real_steps(api):
    taken = []
    for number in range(2):
        name = f"rail-{uuid.uuid4().hex[:8]}"
        api.create_surrogate(name, SPEC)
        with IsolatedEnvironment(Rail) as environment:
            Sampler(api, name, environment, SamplerSettings(until_done=True, time_limit=90.0)).run()
        taken.append([(s.coordinates, s.action, s.next_coordinates) for s in api.samples(name)])
        assert api.surrogate(name).queries.answered > 1, number
        api.delete_surrogate(name)
    assert taken[0] == taken[1]


def test_classic_control_tasks_are_learned_from_rollouts_only(api):
    name = f"pendulum-{uuid.uuid4().hex[:8]}"
    environment = original.make("Pendulum-v1", access="reset", budget=24, seed=1)
    api.create_surrogate(name, environment.spec())
    report = Sampler(api, name, environment, SamplerSettings(until_done=True, time_limit=120.0)).run()
    view = api.surrogate(name)
    assert report.steps == view.ledger.total <= 24
    assert view.fidelity.confidence_index > 0.99
    api.delete_surrogate(name)


@pytest.fixture
def swinging(api):
    """A pendulum that can only be reset, and a surrogate of it."""
    name, machine = f"pendulum-{uuid.uuid4().hex[:8]}", original.make("Pendulum-v1", access="reset", seed=0, budget=30)
    api.create_surrogate(name, machine.spec())
    yield name, machine
    api.delete_surrogate(name)


def trial_of(api, name):
    """The one query that is planned anew, and the samples of its steps."""
    (query,) = [query for query in api.queries(name) if query.replan]
    return query, [sample for sample in api.samples(name) if sample.query_id == query.id]


def test_a_sampler_plans_each_action_of_a_trial_from_the_state_that_it_measured(api, swinging, monkeypatch):
    name, machine = swinging
    planned = []

    def watched(*arguments):
        planner = replanning(*arguments)

        def act(state):
            action = planner(state)
            planned.append((np.asarray(state).tolist(), list(action)))
            return action

        return act

    monkeypatch.setattr("surrogym_sampler.queries.worker.replanning", watched)
    waited = []
    Sampler(api, name, machine, SamplerSettings(until_done=True, time_limit=120.0), waits=waited.append).run()
    (said,) = [sentence for sentence in waited if "planner" in sentence]  # it compiled in silence for a minute and more
    assert "the first process on a machine compiles for a minute" in said
    query, samples = trial_of(api, name)
    assert len(samples) == len(query.actions)
    assert [(sample.coordinates, sample.action) for sample in samples] == planned


def test_a_sampler_that_can_not_plan_applies_the_expected_actions_and_says_why(api, swinging, monkeypatch):
    name, machine = swinging

    def missing(*_):
        raise ImportError("stepping a file needs torch: pip install 'surrogym[server]'")

    monkeypatch.setattr("surrogym_sampler.queries.worker.replanning", missing)
    told = []
    settings = SamplerSettings(until_done=True, time_limit=120.0)
    Sampler(api, name, machine, settings, lambda query, outcome, error: told.append((query, outcome, error))).run()
    query, samples = trial_of(api, name)
    assert [sample.action for sample in samples] == query.actions
    ((outcome, error),) = [(outcome, error) for query, outcome, error in told if getattr(query, "replan", False)]
    assert outcome == "answered"
    assert "none could be planned anew: stepping a file needs torch" in error


def test_a_query_that_is_planned_anew_is_drawn_and_reported_as_such():
    lease = {"id": 7, "number": 0, "purpose": "adaptive", "attempt": 1, "lease_token": "t", "lease_seconds": 60.0}
    trial = RolloutQuery(**lease, actions=[[0.5], [-0.5]], replan=True)
    assert line_of(trial, "answered", "") == "query 7 (adaptive, 2 steps planned anew) answered"
    first = words_of_query(SPEC, trial)[0]
    assert first.endswith("from a reset, each action planned anew from the measured state; expected:")
    assert "anew" not in words_of_query(SPEC, trial.model_copy(update={"replan": False}))[0]


@pytest.fixture
def policy():
    """A network with random weights for the rail, and its file in base64."""
    weights = np.random.default_rng(0).normal(size=Network.size(SPEC, 4))
    network = Network.of(SPEC, np.zeros(1), np.ones(1), 4, weights)
    return network, b64encode(network.to_bytes()).decode()


def test_in_a_trial_a_policy_acts_on_the_states_that_were_measured(api, rail, policy):
    network, file = policy
    before, expected = api.surrogate(rail), [[0.0]] * 8
    granted = api.improve(rail, trial=Trial(policy=file, actions=expected))
    assert granted.budget_raised_by == 8 - before.budget_left
    lines = []
    told = lambda query, outcome, error: lines.append(line_of(query, outcome, error))  # noqa: E731
    Sampler(api, rail, Rail(), SamplerSettings(until_done=True, time_limit=60.0), told).run()
    (query,) = [query for query in api.queries(rail) if query.policy]
    assert f"query {query.id} (adaptive, 8 steps of a policy) answered" in lines
    samples = [sample for sample in api.samples(rail) if sample.query_id == query.id]
    assert (query.actions, len(samples)) == (expected, 8)
    chosen = [network(observe(SPEC, np.array([sample.coordinates])))[0].tolist() for sample in samples]
    assert [sample.action for sample in samples] == [pytest.approx(action) for action in chosen]


def test_a_trial_that_does_not_fit_the_surrogate_is_refused_and_changes_nothing(api, rail, policy):
    network, file = policy
    before = api.surrogate(rail)
    other = Network(np.zeros(2), np.ones(2), (Layer(np.zeros((2, 1)), np.zeros(1)),), network.low, network.high)
    wrong = {
        "in base64": Trial(policy="no base64!", actions=[[0.0]] * 3),
        "is not a policy of surrogym train": Trial(policy="AAAA", actions=[[0.0]] * 3),
        "expected a policy of 1 observation entries and 1 continuous actions, got one of 2 ": Trial(
            policy=b64encode(other.to_bytes()).decode(), actions=[[0.0]] * 3
        ),
        "expected at most 20 actions in a rollout, got 21": Trial(policy=file, actions=[[0.0]] * 21),
        "action": Trial(policy=file, actions=[[9.0]]),
    }
    for said, trial in wrong.items():
        with pytest.raises(InvalidInput, match=said):
            api.improve(rail, trial=trial)
    for queries, trial in ((3, wrong["action"]), (None, None)):
        with pytest.raises(ValueError, match="expected either queries or trial"):
            api.improve(rail, queries, trial=trial)
    after = api.surrogate(rail)
    assert (after.budget, after.queries, after.phase) == (before.budget, before.queries, before.phase)
    anywhere = f"pendulum-{uuid.uuid4().hex[:8]}"
    api.create_surrogate(anywhere, original.make("Pendulum-v1").spec())
    with pytest.raises(InvalidInput, match="expected an original environment that can only be reset"):
        api.improve(anywhere, trial=Trial(policy=file, actions=[[0.0]]))
    api.delete_surrogate(anywhere)


def test_a_trial_whose_policy_overflows_is_refused_for_good_before_any_step(api, rail):
    huge = np.full((1, 2), 1e308), np.array([1e308, 1e308])
    layers = (Layer(*huge), Layer(np.array([[1e308], [-1e308]]), np.zeros(1)))
    network = Network(np.zeros(1), np.ones(1), layers, -np.ones(1), np.ones(1), activation="relu")
    api.improve(rail, trial=Trial(policy=b64encode(network.to_bytes()).decode(), actions=[[0.0]] * 3))
    with np.errstate(all="ignore"):
        Sampler(api, rail, Rail(), SamplerSettings(until_done=True, time_limit=60.0)).run()
    (query,) = [query for query in api.queries(rail) if query.policy]
    assert query.status == "refused"
    assert "the policy of the trial chose an action that is no finite number: [nan]" in query.error
    assert not [sample for sample in api.samples(rail) if sample.query_id == query.id]


def test_a_sampler_refuses_a_policy_that_does_not_fit_its_environment(policy):
    with pytest.raises(ValueError, match="expected a policy of 3 observation entries"):
        following(policy[0].to_bytes(), original.make("Pendulum-v1").spec())
    with pytest.raises(ValueError, match="is not a policy of surrogym train"):
        following(b"PK", SPEC)


class Long(Rail):
    """A rail whose episodes may have 600 steps."""

    def spec(self):
        return SPEC.model_copy(update={"time_limit": 600, "max_rollout": 600})


def test_a_rollout_of_many_steps_is_answered_whole(api):
    """Its samples have more than 96 KiB, the size of the requests in which other samples are sent."""
    name = f"long-{uuid.uuid4().hex[:8]}"
    api.create_surrogate(name, Long().spec())
    api.add_queries(name, rollouts=[[LEFT, RIGHT] * 300])
    told = []
    settings = SamplerSettings(name="worker", max_queries=len(api.queries(name)), wait_seconds=5.0)
    Sampler(api, name, Long(), settings, lambda *one: told.append(one[1:])).run()
    assert set(told) == {("answered", "")}
    (query,) = [query for query in api.queries(name) if len(query.actions) == 600]
    assert len([sample for sample in api.samples(name) if sample.query_id == query.id]) == 600
    api.delete_surrogate(name)
