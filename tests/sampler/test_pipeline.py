"""Beside a real step, the answer before it is sent and the queries after it are claimed; no promise is lost by it."""

from __future__ import annotations

import threading
import uuid

import pytest

from support.moody import SPEC, Line
from surrogym_client.errors import InvalidInput, ServerUnreachable
from surrogym_client.transport import Api
from surrogym_sampler.queries import Sampler, SamplerSettings, pipeline, worker
from surrogym_sampler.queries.pipeline import Pipeline
from surrogym_shared.codes import Code, Problem
from surrogym_shared.wire import ClaimedQueries

PATIENCE = 60.0
MOST = 20  # steps of a test
ONE = SamplerSettings(name="one", batch=1, max_queries=6, wait_seconds=5.0, time_limit=PATIENCE)


def awaited(event: threading.Event) -> None:
    assert event.wait(PATIENCE)


class Noting(Line):
    """Notes where it steps; ``then`` is called in the middle of the step with that number, from 1."""

    def __init__(self, **then):
        self.steps, self.begun = [], [threading.Event() for _ in range(MOST)]
        self.then = {int(name.removeprefix("in_")): call for name, call in then.items()}

    def step_from(self, coordinates, action):
        self.steps.append((*coordinates.tolist(), *action.tolist()))
        self.begun[len(self.steps)].set()
        self.then.get(len(self.steps), lambda: None)()
        return super().step_from(coordinates, action)


class Watched(Api):
    """Says when a claim has returned queries, and calls ``before`` before each answer, with its number from 1."""

    def __init__(self, url, before=lambda _: None):
        super().__init__(url)
        self.before, self.answers, self.claimed = before, 0, [threading.Event() for _ in range(MOST)]
        self.claims = 0

    def claim(self, *args, **options):
        claimed = super().claim(*args, **options)
        if claimed.queries:
            self.claims += 1
            self.claimed[self.claims].set()
        return claimed

    def add_samples(self, *args, **options):
        self.answers += 1
        self.before(self.answers)
        return super().add_samples(*args, **options)


def test_a_real_step_starts_while_the_previous_sample_is_being_sent(server_process, line):
    """The first answer shows that the server accepts answers, so only later ones overlap with steps."""
    machine = Noting()
    with Watched(server_process.url, lambda number: number == 1 or awaited(machine.begun[min(number + 1, 6)])) as api:
        report = Sampler(api, line, machine, ONE).run()
        assert (report.answered, report.failed, api.surrogate(line).ledger.total) == (6, 0, 6)


def test_at_most_one_real_step_starts_before_the_previous_sample_is_acknowledged(server_process, line):
    machine, held = Noting(), threading.Event()

    def before(number: int) -> None:
        if number == 2:
            awaited(machine.begun[3])
            held.set()
            assert not machine.begun[4].wait(0.5), "the answer of the second step is not acknowledged yet"

    with Watched(server_process.url, before) as api:
        assert Sampler(api, line, machine, ONE).run().answered == 6
    assert held.is_set()


class InTurns(Pipeline):
    """As a sampler without a pipeline."""

    def step(self, step, claim):
        return super().step(step, None)

    def send(self, answer, *, clean, last):
        super().send(answer, clean=False, last=last)


@pytest.mark.parametrize("batch", [1, 4])
def test_a_pipelined_sampler_takes_the_same_real_steps_as_a_sequential_one(api, monkeypatch, batch):
    taken = []
    design = SPEC.design.model_copy(update={"initial": 5, "budget": 9})
    spec = SPEC.model_copy(update={"design": design, "tolerances": {"x": 1e-9, "reward": 1e-9}})
    for made in (Pipeline, InTurns):
        monkeypatch.setattr(worker, "Pipeline", made)
        name, machine = f"line-{uuid.uuid4().hex[:8]}", Noting()
        api.create_surrogate(name, spec)
        settings = SamplerSettings(name="one", batch=batch, until_done=True, time_limit=90.0)
        report = Sampler(api, name, machine, settings).run()
        assert (report.answered, report.steps, len(machine.steps)) == (9, 9, 9)
        assert [sample.query_id for sample in api.samples(name)] == [query.id for query in api.queries(name)]
        taken.append(machine.steps)
        api.delete_surrogate(name)
    assert taken[0] == taken[1]


def test_the_samplers_query_limit_counts_queries_in_progress(server_process, line):
    with Api(server_process.url) as api:
        report = Sampler(api, line, Noting(), SamplerSettings(batch=1, max_queries=4, wait_seconds=5.0)).run()
        view = api.surrogate(line)
    assert (report.answered, view.queries.pending, view.queries.leased) == (4, 2, 0)


def test_a_query_fetched_ahead_is_released_if_the_current_step_takes_long(server_process, line, monkeypatch):
    monkeypatch.setattr(pipeline, "HELD_SECONDS", 0.0)
    with Watched(server_process.url) as api:

        def let_another_work() -> None:
            awaited(api.claimed[3])
            with Api(server_process.url) as second:
                others = SamplerSettings(name="other", batch=1, max_queries=4, wait_seconds=5.0, time_limit=PATIENCE)
                assert Sampler(second, line, Line(), others).run().answered == 4
            sampler.stop()

        machine = Noting(in_2=let_another_work)
        sampler = Sampler(api, line, machine, ONE)
        assert sampler.run().answered == 2
        view = api.surrogate(line)
    assert (view.ledger.total, view.ledger.unresolved, view.queries.leased) == (6, 0, 0)
    assert len(machine.steps) == 2


@pytest.mark.parametrize("error", [None, KeyboardInterrupt])
def test_a_stopped_sampler_returns_queries_fetched_ahead_and_loses_no_sample(server_process, line, error):
    with Watched(server_process.url) as api:

        def stop() -> None:
            awaited(api.claimed[4])
            if error is not None:
                raise error
            sampler.stop()

        machine = Noting(in_3=stop)
        sampler = Sampler(api, line, machine, ONE)
        try:
            report = sampler.run()
        except KeyboardInterrupt:
            report = sampler.summary()
        view = api.surrogate(line)
    done = 3 if error is None else 2
    assert (len(machine.steps), report.answered, view.ledger.total) == (3, done, done)
    assert (view.queries.leased, view.queries.pending) == (0, 6 - done)
    assert view.ledger.unresolved == 3 - done, "only the interrupted step may have moved the robot"


def test_a_sample_refused_by_the_server_fails_its_query(server_process, line):
    def before(number: int) -> None:
        if number == 2:
            awaited(machine.begun[3])
            raise InvalidInput(Problem(title="no", status=422, code=Code.INVALID_REQUEST, detail="not a number"))

    machine, told = Noting(), []
    with Watched(server_process.url, before) as api:
        settings = SamplerSettings(name="one", batch=1, until_done=True, time_limit=PATIENCE)
        report = Sampler(api, line, machine, settings, lambda *seen: told.append(seen)).run()
        assert api.surrogate(line).ledger.total == 6
    assert (report.answered, report.failed) == (6, 1)
    assert [outcome for _, outcome, _ in told[:3]] == ["answered", "failed", "answered"], "reported in order"
    assert machine.steps[3] == machine.steps[1], "it is the oldest of the queue, and so the next one"


def flowing(settled: list[int], given_back: list[ClaimedQueries]) -> Pipeline[int]:
    """A pipeline whose first answer was accepted."""
    made = Pipeline[int](lambda answer: settled.append(answer) is None, given_back.append)
    made.step(lambda: None, None)
    made.send(lambda: 0, clean=True, last=True)
    return made


def test_the_error_of_a_sample_that_cannot_be_sent_is_raised_once():
    def away() -> int:
        raise ServerUnreachable("nobody answers")

    settled: list[int] = []
    made = flowing(settled, [])
    made.send(away, clean=True, last=False)
    with pytest.raises(ServerUnreachable, match="nobody answers"):
        made.send(lambda: 2, clean=True, last=False)
    made.close()
    assert settled == [0]


def test_a_real_step_that_ends_early_fetches_no_query_ahead():
    made = flowing([], [])
    made._step_seconds = 3_600.0

    def claim() -> ClaimedQueries:
        raise AssertionError("it began before the expected end of the step")

    made.step(lambda: None, claim)
    made.send(lambda: 1, clean=True, last=True)
    assert made.next() is None
