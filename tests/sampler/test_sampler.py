"""The worker against a real server: every query is answered or fails with its reason, and the worker stays alive."""

from __future__ import annotations

import threading
import time
from functools import partial

import pytest

from support.moody import SPEC, GivesNonsense, HangsLeft, Line, RaisesLeft, Slow
from surrogym_client.errors import ServerUnreachable, Unavailable, UnknownSurrogate
from surrogym_client.transport import Api, Retries
from surrogym_sampler import original
from surrogym_sampler.original.errors import UnknownEnvironment
from surrogym_sampler.original.isolated import IsolatedEnvironment
from surrogym_sampler.queries import Sampler, SamplerReport, SamplerSettings
from surrogym_shared.codes import Code, Problem
from surrogym_shared.spec import BoxAction
from surrogym_shared.wire import ClaimedQueries

ONE_ROUND = SamplerSettings(name="worker", max_queries=6, wait_seconds=5.0, time_limit=60.0)


def test_the_sampler_answers_every_query_and_stops_when_the_design_is_done(api, line):
    told, ended = [], []
    settings = SamplerSettings(until_done=True, time_limit=90.0)
    report = Sampler(api, line, Line(), settings, lambda *seen: told.append(seen), ended.append).run()
    view = api.surrogate(line)
    assert (report.answered, report.failed) == (6, 0)
    assert view.ledger.total == 6
    assert report.phase == view.phase
    assert view.phase in ("ready", "over_budget")
    assert [outcome for _, outcome, _ in told] == ["answered"] * 6
    assert ended == [view.phase]


def test_a_sampler_says_once_that_it_waits_for_a_long_fit(api, line, monkeypatch):
    said = []
    sampler = Sampler(api, line, Line(), SamplerSettings(once=True, time_limit=60.0), waits=said.append)
    claims = [ClaimedQueries(queries=[], phase="fitting", paused=False)] * 4
    monkeypatch.setattr(sampler, "_awaited", lambda _: claims.pop() if claims else None)
    sampler.run()
    assert said == ["the server fits a model; this sampler waits for its next queries"]


class StorageAway(Api):
    """Its server's storage can't be used for a moment, each time something is asked of it."""

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self.refused = set()

    def _refuse_once(self, *request):
        if request not in self.refused:
            self.refused.add(request)
            problem = Problem(title="unavailable", status=503, code=Code.UNAVAILABLE, detail="the disk is full")
            raise Unavailable(problem)

    def claim(self, name, sampler, **options):
        self._refuse_once("claim")
        return super().claim(name, sampler, **options)

    def add_samples(self, name, sampler, samples, **options):
        self._refuse_once("add", samples[0].query_id)
        return super().add_samples(name, sampler, samples, **options)


def test_the_sampler_waits_for_an_unavailable_storage_without_repeating_steps(server_process, line):
    said = []
    with StorageAway(server_process.url) as api:
        report = Sampler(api, line, Line(), ONE_ROUND, waits=said.append).run()
        assert len(api.refused) == len(said) == 7
        assert said[0].startswith("the disk is full"), "it was silent for up to 15 minutes"
        assert said[0].endswith("; this sampler tries again for 15 minutes")
        ledger = api.surrogate(line).ledger
    assert (report.answered, report.failed, ledger.total, ledger.unresolved) == (6, 0, 6, 0)


class Waits(Api):
    """Tells when a claim of a sampler begins and ends, apart from that of no queries by which it says that it ends."""

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self.began, self.ended = threading.Event(), threading.Event()

    def claim(self, name, sampler, **options):
        self.began.set()
        try:
            return super().claim(name, sampler, **options)
        finally:
            if options["max_queries"]:
                self.ended.set()


def test_a_sampler_that_is_stopped_while_it_waits_ends_at_once_and_gives_back_what_comes_later(server_process, line):
    """It waited for up to 20 s, so the demo killed its server before it had saved."""
    with Api(server_process.url) as other, Waits(server_process.url) as api:
        *_, last = other.claim(line, "other", max_queries=6, wait_seconds=5.0).queries
        sampler = Sampler(api, line, Line(), SamplerSettings(batch=1, wait_seconds=30.0))
        thread = threading.Thread(target=sampler.run)
        thread.start()
        assert api.began.wait(30)
        sampler.stop()
        thread.join(10)
        assert not thread.is_alive()
        assert not api.ended.is_set()
        deadline = time.monotonic() + 20
        while other.surrogate(line).samplers != ["other"]:
            assert time.monotonic() < deadline, "it still counts as connected"
            time.sleep(0.02)
        other.fail(line, last.id, last.lease_token, "not begun", begun=False)
        assert api.ended.wait(20)
        deadline = time.monotonic() + 20
        while other.surrogate(line).queries.pending == 0:
            assert time.monotonic() < deadline
            time.sleep(0.02)


class Away(Api):
    """A server that stays away, for one kind of request."""

    def __init__(self, url: str, request: str) -> None:
        super().__init__(url)
        self.asked = threading.Event()
        setattr(self, request, self._refuse)

    def _refuse(self, *_, **__):
        self.asked.set()
        raise ServerUnreachable("nobody answers")


def stopped(api: Away, line: str) -> tuple[list[SamplerReport], list[Exception]]:
    """What a sampler gave, or raised, that was stopped while it waited for a server."""
    reports, errors = [], []
    sampler = Sampler(api, line, Line(), ONE_ROUND)

    def run():
        try:
            reports.append(sampler.run())
        except ServerUnreachable as error:
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    assert api.asked.wait(30)
    sampler.stop()
    thread.join(30)
    assert not thread.is_alive()
    return reports, errors


def test_a_stopped_sampler_does_not_wait_for_an_unreachable_server(server_process, line):
    with Away(server_process.url, "claim") as api:
        [report], errors = stopped(api, line)
    assert (report.answered, errors) == (0, [])


def test_the_sampler_reports_a_real_step_it_cannot_submit(server_process, line, monkeypatch):
    monkeypatch.setattr("surrogym_sampler.queries.worker.LAST_SECONDS", 0.2)
    with Away(server_process.url, "add_samples") as api:
        reports, [error] = stopped(api, line)
    assert reports == []
    assert "nobody answers" in str(error)


def test_the_option_once_stops_the_sampler_after_one_batch_of_queries(api, line):
    report = Sampler(api, line, Line(), SamplerSettings(once=True, batch=2, wait_seconds=5.0)).run()
    assert report.answered == 2
    assert api.surrogate(line).queries.pending == 4


def test_an_exception_in_the_environment_fails_the_query_with_its_error(api, line):
    report = Sampler(api, line, RaisesLeft(), ONE_ROUND).run()
    assert report.answered + report.failed == 6
    assert report.failed > 0
    errors = [query.error for query in api.queries(line) if query.error]
    assert errors
    assert all("there is a wall on the left" in error for error in errors)


def test_a_hanging_environment_is_killed_and_the_sampler_continues(api, line):
    settings = SamplerSettings(name="worker", batch=6, max_queries=6, wait_seconds=5.0)
    with IsolatedEnvironment(HangsLeft, step_limit=0.5) as environment:
        report = Sampler(api, line, environment, settings).run()
    assert report.answered > 0
    assert report.failed > 0
    errors = [query.error for query in api.queries(line) if query.error]
    assert len(errors) == report.failed
    assert all(
        error.startswith("the environment's step_from took longer than 0.5 s and was killed; ") for error in errors
    )


def test_a_step_of_the_wrong_shape_fails_the_query(api, line):
    Sampler(api, line, GivesNonsense(), SamplerSettings(once=True, batch=1, wait_seconds=5.0)).run()
    (failed,) = [query.error for query in api.queries(line) if query.error]
    assert "expected the shape (1,) for next_coordinates of a real step, got (2,)" in failed


def test_the_sampler_renews_a_lease_shorter_than_the_step(api, line):
    settings = SamplerSettings(name="slow", batch=1, once=True, lease_seconds=0.9, wait_seconds=5.0)
    Sampler(api, line, Slow(), settings).run()
    (sample,) = api.samples(line)
    assert not sample.late
    assert sample.attempt == 1


def test_a_stopped_sampler_returns_its_leased_queries(api, line):
    settings = SamplerSettings(batch=6, wait_seconds=5.0)
    sampler = Sampler(api, line, Line(), settings, lambda *_: sampler.stop())
    report = sampler.run()
    view = api.surrogate(line)
    assert report.answered == 1
    assert (view.queries.leased, view.queries.pending) == (0, 5)
    assert view.ledger.unresolved == 0, "what was not begun moved no robot"


class Interrupted(Line):
    """A person stops the second step while it is under way."""

    def __init__(self):
        self.steps = 0

    def step_from(self, coordinates, action):
        self.steps += 1
        if self.steps == 2:
            raise KeyboardInterrupt
        return super().step_from(coordinates, action)


def test_an_interrupted_step_counts_as_unresolved_and_later_queries_are_returned(api, line):
    with pytest.raises(KeyboardInterrupt):
        Sampler(api, line, Interrupted(), SamplerSettings(batch=6, wait_seconds=5.0)).run()
    view = api.surrogate(line)
    assert (view.ledger.total, view.ledger.unresolved) == (1, 1)
    assert (view.queries.leased, view.queries.pending) == (0, 5)


def test_two_concurrent_samplers_answer_each_query_once_between_them(api, line):
    settings = [SamplerSettings(name=name, batch=1, until_done=True, time_limit=90.0) for name in ("first", "second")]
    threads = [threading.Thread(target=Sampler(api, line, Line(), s).run) for s in settings]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert api.surrogate(line).ledger.total == 6


def test_sampling_with_another_environment_than_the_surrogates_is_refused(api, line):
    with pytest.raises(UnknownEnvironment, match=r"expected coordinates \(x\)"):
        Sampler(api, line, original.make("Pendulum-v1")).run()


def test_a_failing_environment_factory_ends_the_sampler_at_once(api, line):
    environment = IsolatedEnvironment(partial(original.make, "Nowhere-v1"))
    with pytest.raises(UnknownEnvironment, match="Nowhere-v1 can't be made"):
        Sampler(api, line, environment).run()
    assert api.surrogate(line).queries.leased == 0


def test_the_sampler_reports_an_unknown_surrogate_or_unreachable_server(server_process):
    with Api(server_process.url) as api, pytest.raises(UnknownSurrogate):
        Sampler(api, "nobody", Line()).run()
    with Api("http://127.0.0.1:9", retries=Retries(seconds=0)) as api, pytest.raises(ServerUnreachable):
        Sampler(api, "nobody", Line()).run()


class Careful(Line):
    """Takes smaller actions than the surrogate was told when it was registered."""

    def spec(self):
        return SPEC.model_copy(update={"action": BoxAction(low=(-0.5,), high=(1.0,))})


def test_a_surrogate_with_actions_the_environment_forbids_is_refused_before_a_step(api, line):
    with pytest.raises(UnknownEnvironment, match=r"expected actions from \[-0.5\] to \[1\], got \[-1\] to \[1\]"):
        Sampler(api, line, Careful()).run()
    assert api.surrogate(line).queries.leased == 0
