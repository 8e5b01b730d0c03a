"""A fault of the machine is not one of the queries: it does not use up their attempts, and a mended machine goes on."""

from __future__ import annotations

import pytest

from support.moody import Line
from surrogym_sampler.original.errors import FallbackFailed, MachineFails, StepRefused
from surrogym_sampler.original.isolated import IsolatedEnvironment
from surrogym_sampler.queries import Sampler, SamplerSettings
from surrogym_sampler.queries import failures as limits
from surrogym_sampler.queries.failures import FIRST_FEW, LONGEST_DELAY, MANY, Failures

UNTIL_DONE = SamplerSettings(name="worker", until_done=True, time_limit=60.0)


class Switched(Line):
    """A machine that can be off."""

    on = False

    def step_from(self, coordinates, action):
        if not self.on:
            raise OSError("[Errno 5] the bus is off")
        return super().step_from(coordinates, action)


class Careful(Line):
    """A machine that refuses what would overflow, before it moves."""

    def step_from(self, coordinates, action):
        if coordinates[0] < 0:
            raise StepRefused("the tank would overflow")
        return super().step_from(coordinates, action)


class Unstoppable(Line):
    """A machine whose fallback fails after its second step."""

    steps = 0

    def step_from(self, coordinates, action):
        self.steps += 1
        if self.steps > 2:
            raise FallbackFailed("stop it by hand: no brake pressure")
        return super().step_from(coordinates, action)


class Refusing(Line):
    def step_from(self, coordinates, action):
        raise StepRefused("the lid is open")


@pytest.fixture(autouse=True)
def _no_delay(monkeypatch):
    monkeypatch.setattr(limits, "FIRST_DELAY", 0.0)


@pytest.mark.parametrize("batch", [2, 4])
def test_the_sampler_stops_before_a_broken_environment_uses_up_every_query(api, line, batch):
    machine = Switched()
    settings = SamplerSettings(name="worker", until_done=True, batch=batch, time_limit=60.0)
    with pytest.raises(MachineFails, match=r"different queries in a row.*the bus is off; repair it"):
        Sampler(api, line, machine, settings).run()
    view = api.surrogate(line)
    assert (view.phase, view.queries.set_aside, view.queries.pending) == ("collecting", 0, 6)
    machine.on = True
    report = Sampler(api, line, machine, UNTIL_DONE).run()
    assert (report.answered, report.failed) == (6, 0)


def test_a_design_that_failed_by_its_environment_continues_when_resumed(api, line, monkeypatch):
    """Somebody started the sampler again and again beside the broken machine."""
    monkeypatch.setattr(limits, "FIRST_DELAY", 0.01)
    machine = Switched()
    for _ in range(20):
        if api.surrogate(line).phase == "failed":
            break
        try:
            Sampler(api, line, machine, UNTIL_DONE).run()
        except MachineFails:
            continue
    assert api.surrogate(line).phase == "failed"
    machine.on = True
    assert Sampler(api, line, machine, UNTIL_DONE).run().phase == "failed"
    resumed = api.patch_surrogate(line, paused=False)
    assert (resumed.phase, resumed.queries.pending, resumed.error) == ("collecting", 6, None)
    report = Sampler(api, line, machine, UNTIL_DONE).run()
    assert (report.answered, report.phase in ("ready", "over_budget")) == (6, True)


def test_an_environment_that_answers_between_failures_is_not_taken_for_broken():
    failures = Failures()
    for query in range(100):
        failures.failed(query, "a wall")
        failures.check([query + 1])
        assert failures.delay() == 0.0
        failures.answered()


def test_a_single_failing_query_never_stops_the_sampler():
    failures = Failures()
    for _ in range(10):
        failures.failed(1, "a wall")
        failures.check([1])


def test_on_repeated_failures_the_sampler_waits_longer_and_finally_stops(monkeypatch):
    monkeypatch.setattr(limits, "FIRST_DELAY", 1.0)
    failures = Failures()
    failures.failed(0, "a wall")
    failures.answered()
    delays = []
    for query in range(1, MANY):
        failures.failed(query, "no power")
        failures.check([query])
        delays.append(failures.delay())
    assert delays == [0.0] * (FIRST_FEW - 1) + [1.0, 2.0, 4.0, 8.0]
    for _ in range(10):
        failures.failed(1, "no power")
    assert failures.delay() == LONGEST_DELAY
    failures.failed(MANY, "no power")
    with pytest.raises(MachineFails, match=f"failed at {MANY} different queries in a row.*no power"):
        failures.check([1])


@pytest.mark.parametrize("machine", [Careful, lambda: IsolatedEnvironment(Careful)], ids=["here", "isolated"])
def test_a_query_refused_by_the_environment_counts_as_no_attempt(api, line, machine):
    """The initial queries are spread over both sides. The design then asks on the other one."""
    told = []
    environment = machine()
    report = Sampler(api, line, environment, UNTIL_DONE, lambda _, *seen: told.append(seen)).run()
    environment.close()
    view = api.surrogate(line)
    assert view.queries.refused == report.refused > 0
    assert told.count(("refused", "the tank would overflow")) == report.refused
    assert (report.failed, view.queries.set_aside, view.ledger.unresolved) == (0, 0, 0)
    assert view.phase == "ready" or view.ledger.total == view.budget, "the refused ones used nothing of it"
    assert all(query.attempts == 1 for query in api.queries(line) if query.status == "refused")


@pytest.mark.parametrize("machine", [Unstoppable, lambda: IsolatedEnvironment(Unstoppable)], ids=["here", "isolated"])
def test_a_sampler_whose_fallback_failed_begins_no_other_query(api, line, machine):
    environment = machine()
    with pytest.raises(MachineFails, match=r"stop it by hand: no brake pressure; no other query was begun"):
        Sampler(api, line, environment, UNTIL_DONE).run()
    environment.close()
    view = api.surrogate(line)
    assert (view.queries.answered, view.queries.pending, view.queries.leased) == (2, 4, 0)
    assert view.ledger.unresolved == 1


def test_a_design_whose_initial_queries_are_all_refused_reports_it(api, line):
    report = Sampler(api, line, Refusing(), UNTIL_DONE).run()
    view = api.surrogate(line)
    assert (report.phase, view.phase, report.failed, view.ledger.unresolved) == ("failed", "failed", 0, 0)
    assert view.error is not None
    assert "refused by the original environment" in view.error
    assert "the lid is open" in view.error
    resumed = api.patch_surrogate(line, paused=False)
    assert (resumed.phase, resumed.queries.pending) == ("collecting", 6)
