"""The sampler: claims queries, takes the real steps, and sends the samples."""

from __future__ import annotations

import time
from base64 import b64decode
from collections import deque
from collections.abc import Callable
from concurrent.futures import wait
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar, get_args

import numpy as np

from surrogym_client.errors import InvalidInput, LeaseExpired, NotThere
from surrogym_client.surrogates.waiting import ENDED
from surrogym_client.transport.api import Api
from surrogym_client.transport.connection import AWAY, ONE_ATTEMPT, Retries
from surrogym_sampler.original.errors import (
    FallbackFailed,
    QueryRefused,
    SnapshotGone,
    StepFailed,
    StepRefused,
    message_of,
)
from surrogym_sampler.original.periods import is_timed
from surrogym_sampler.original.protocol import (
    Environment,
    OriginalEnvironment,
    RolloutEnvironment,
)
from surrogym_sampler.original.rollouts import answering
from surrogym_sampler.queries.acting import Acting, following, replanning
from surrogym_sampler.queries.failures import Failures, Violations
from surrogym_sampler.queries.leases import LeaseEnded, Leases
from surrogym_sampler.queries.pipeline import Pipeline, beside
from surrogym_sampler.queries.query_limits import check_action, check_environment, check_query
from surrogym_sampler.queries.returning import Returning, snapshots_of
from surrogym_sampler.queries.sample_conversion import reset_seed, sample_of
from surrogym_sampler.queries.settings import Outcome, SamplerReport, SamplerSettings
from surrogym_shared.periods import irregular
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.starts import not_declared
from surrogym_shared.wire import ClaimedQueries, NewSample, Phase, Query, RolloutQuery, StepQuery
from surrogym_shared.wrapping import undeclared_turns

# Retries of a request while the server or its storage does not answer.
PATIENCE = Retries(seconds=900.0, first_delay=0.1, longest_delay=5.0)
LOOK_SECONDS = 0.1  # seconds between two checks by a waiting sampler of whether it was stopped
LAST_SECONDS = 5.0  # a stopped sampler tries for these seconds to send its last real step
MANY_FRUITLESS = 2  # number of claims in a row that meet a fit, after which the sampler says that it waits
END_SECONDS = 2.0  # if the sampler ends with the design, a claim for queries waits at most this many seconds
AGAIN_SECONDS = 1.0  # seconds to wait after a claim that gave no query which the environment allows
LATEST = 1_000  # number of latest steps of rollouts in which coordinates that wrap are looked for
MOST_GONE = 1_000  # largest number of deleted snapshots in one report to the server
STOPPED = "the sampler was stopped"
NOT_APPROVED = "the person at the machine did not approve the query"

T = TypeVar("T")


@dataclass(frozen=True)
class _Answer:
    """The answer to a query.

    Attributes:
        query: the query.
        taken: samples of its real steps.
        outcome: the outcome if there are no real steps.
        error: what went wrong; empty if nothing did.
        remark: a fault that did not harm the answer; empty if there was none.
        for_good: whether the environment itself refused the query, so that no other sampler should try it.
    """

    query: Query
    taken: list[NewSample]
    outcome: Outcome
    error: str
    remark: str = ""
    for_good: bool = False

    @property
    def clean(self) -> bool:
        return bool(self.taken) and not self.error


class Sampler:
    """Answers the queries of one surrogate with real steps.

    While the environment steps, the sampler sends the answer to the previous query and claims the next one. So the
    environment waits for no request, as long as all answers are accepted. At most one answered query is not
    acknowledged yet. A query is claimed shortly before the running step ends, and returned if the step takes longer.

    If a step fails, its query is returned with the error; in a rollout, the steps before it are the answer. If the
    server does not answer, the sampler waits and keeps its samples.

    No real step begins after the lease of its query has ended, for example while the machine was suspended: another
    sampler may have taken the query. A step that is running then is finished and sent.

    After failures at several different queries in a row, the sampler waits longer and longer, and then ends. So a fault
    of the machine does not use up the three attempts that each query has. It also ends if too many rollouts left
    a limit.

    The server is not trusted with the environment. Each query is checked against the environment's own specification.
    One that it does not allow is returned as not begun, and nothing is sent to the environment.

    Args:
        api: the connection to the server.
        surrogate: name of the surrogate.
        environment: the original environment; wrap it in ``IsolatedEnvironment`` if it may hang or crash.
        settings: when to stop, and how many queries to claim.
        report: called after every query with the query, its outcome, and the error if there was one.
        ended: called with the phase whenever a claim shows that the design has ended, once for each end.
        approve: called before each query; False refuses it. None takes every query.
        waits: called with a sentence when the machine stands still for what may take a minute: a fit, a compilation, a
            server that does not answer.

    Examples:
        >>> with Api("http://127.0.0.1:8000") as api:
        ...     Sampler(api, "pendulum", original.make("Pendulum-v1")).run()
    """

    def __init__(
        self,
        api: Api,
        surrogate: str,
        environment: Environment,
        settings: SamplerSettings | None = None,
        report: Callable[[Query, Outcome, str], None] | None = None,
        ended: Callable[[Phase], None] | None = None,
        approve: Callable[[Query], bool] | None = None,
        waits: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._api = api
        self._surrogate = surrogate
        self._environment = environment
        self._settings = settings or SamplerSettings()
        self._report = report
        self._ended = ended
        self._approve = approve
        self._waits = waits
        self._fruitless = 0  # number of claims in a row that waited for queries and met a fit
        self._planned = False  # whether this process has made a planner
        self._counts: dict[Outcome, int] = dict.fromkeys(get_args(Outcome), 0)
        self._refused: set[int] = set()  # ids of refused queries, which the server may offer again
        self._failures = Failures()
        self._steps = 0
        self._latest: deque[NewSample] = deque(maxlen=LATEST)  # the latest steps of rollouts
        self._remark = ""  # fault that did not harm the answer of the present query; "" if there was none
        self._begun: Query | None = None  # query whose real steps began last
        self._returning: Returning | None = None  # the environment's snapshots; None if it has none
        self._phase: Phase | None = None
        self._timed = False  # whether the seconds between steps are measured
        self._spec: EnvironmentSpec
        self._own: EnvironmentSpec
        self._violations: Violations
        self._leases: Leases
        self._pipeline = Pipeline(self._settle, self._return)
        self._started = time.monotonic()
        self._broken_off = False  # whether an error or Ctrl-C ended the run
        self._stopping = False  # a bool, because setting a threading.Event in a signal handler can deadlock

    def stop(self) -> None:
        """Let ``run`` end after the running step. Call this from another thread or a signal handler.

        The sampler then no longer waits for queries, or for a server that does not answer, except for ``LAST_SECONDS``
        to send its last real step. The time in which ``api`` retries a single request adds to this.
        """
        self._stopping = True

    def run(self) -> SamplerReport:
        """Answer queries until a setting ends the run, ``stop`` is called, or Ctrl-C is pressed.

        Raises:
            UnknownSurrogate: there is no surrogate of this name, or it was deleted.
            ServerUnreachable, Unavailable: the server, or its storage, did not answer for too long.
            UnknownEnvironment: the environment can't be made, or does not fit the surrogate.
            MachineFails: the environment failed at several queries in a row, or its fallback failed.
            LimitsLeft: more rollouts left a limit than the allowed share of episodes explains.
        """
        self._started, self._broken_off = time.monotonic(), False
        self._check()
        leases = Leases(self._api, self._surrogate, self._settings.lease_seconds)
        saved = snapshots_of(self._api, self._surrogate, self._environment, self._own, self._settings)
        try:
            with saved as self._returning, leases as self._leases, closing(self._pipeline):
                self._report_gone()
                try:
                    self._answer_all()
                except BaseException:
                    self._broken_off = True  # the answer that is being sent is still finished, but with few retries
                    raise
        finally:
            self._say_farewell()
        return self.summary()

    def _say_farewell(self) -> None:
        """Tell the server that this sampler ends, which it would notice after a minute."""
        said = beside(partial(self._claim, 0, 0.0, ONE_ATTEMPT))
        if wait([said], END_SECONDS).not_done:  # the server hangs, and the owner may close the connection before
            said.add_done_callback(lambda _: self._api.close())

    def _answer_all(self) -> None:
        while not self._stopped() and (limit := self._limit()) > 0:
            try:
                claimed = self._pipeline.next() or self._patiently(partial(self._awaited, limit))
            except AWAY:
                if self._stopped():
                    break
                raise
            if claimed is None:
                break
            self._enter(claimed)
            self._work(claimed.queries)
            if self._enough(claimed):
                break
            if claimed.queries and self._none_allowed(claimed):
                self._pause(AGAIN_SECONDS)

    def summary(self) -> SamplerReport:
        """Return the report of the run so far."""
        seconds = time.monotonic() - self._started
        fallback_steps = getattr(self._environment, "fallback_steps", 0)
        return SamplerReport(
            **self._counts, steps=self._steps, seconds=seconds, phase=self._phase, fallback_steps=fallback_steps
        )

    def _enter(self, claimed: ClaimedQueries) -> None:
        phase = claimed.phase
        before, self._phase = self._phase, phase
        self._fruitless = self._fruitless + 1 if phase == "fitting" and not claimed.queries else 0
        if self._fruitless == MANY_FRUITLESS:
            self._waits("the server fits a model; this sampler waits for its next queries")
        if self._ended is not None and phase in ENDED and phase != before:
            self._ended(phase)

    def _check(self) -> None:
        """Raise ``UnknownEnvironment`` if the environment does not fit the surrogate."""
        self._environment = answering(self._environment)
        self._spec, self._own = self._api.surrogate(self._surrogate).spec, self._environment.spec()
        check_environment(self._surrogate, self._spec, self._own)
        self._violations = Violations(self._own)
        self._timed = is_timed(self._environment, self._own)

    def _wait_seconds(self) -> float:
        """Return the seconds that the next claim waits for queries."""
        s = self._settings
        if s.until_done and (self._phase is None or self._phase in ENDED):
            return 0.0
        return self._within_time(min(s.wait_seconds, END_SECONDS) if s.until_done else s.wait_seconds)

    def _awaited(self, limit: int) -> ClaimedQueries | None:
        """Claim queries, and wait for them if there are none. None if the sampler was stopped while it waited."""

        def claim(wait_seconds: float) -> ClaimedQueries:
            claimed = self._claim(limit, wait_seconds)
            if self._stopped():  # nobody waits for the queries
                self._return(claimed)
            return claimed

        waiting = beside(partial(claim, self._wait_seconds()))
        while not self._stopped():
            if wait([waiting], LOOK_SECONDS).done:
                return waiting.result()
        # The claim may begin after the sampler's owner has closed the connection, and connects again then.
        waiting.add_done_callback(lambda _: self._api.close())
        return None

    def _claim(self, limit: int, wait_seconds: float, retries: Retries | None = None) -> ClaimedQueries:
        s, since = self._settings, self._leases.clock()
        claimed = self._api.claim(
            self._surrogate,
            s.name,
            max_queries=limit,
            wait_seconds=wait_seconds,
            lease_seconds=s.lease_seconds,
            retries=retries,
        )
        self._leases.hold(claimed.queries, since)
        return claimed

    def _work(self, queries: list[Query]) -> None:
        """Answer queries one by one. Queries that are left after Ctrl-C or the time limit are returned to the queue."""
        left, self._begun = list(queries), None
        try:
            while left:
                self._violations.check()
                self._failures.check([query.id for query in left])
                self._pause(self._within_time(self._failures.delay()))
                if self._stopped() or self._out_of_time():
                    break
                self._answer(left[0], last=len(left) == 1)
                left.pop(0)
        finally:
            for query in left:
                self._leases.release(query)
                self._give_back(query, STOPPED, begun=query is self._begun)

    def _return(self, claimed: ClaimedQueries) -> None:
        """Return queries that were not begun to the queue."""
        for query in claimed.queries:
            self._leases.release(query)
            self._give_back(query, STOPPED, begun=False)

    def _answer(self, query: Query, *, last: bool) -> None:
        """Take the real steps of a query, and send them; ``last`` means that no claimed query is left after it."""
        flows = not self._settings.once
        ahead = self._limit(running=1) if flows and last else 0
        claim = partial(self._claim, ahead, 0.0, ONE_ATTEMPT) if ahead > 0 else None
        answer = self._pipeline.step(partial(self._step, query), claim)
        if query.kind == "rollout":
            self._violations.rollout(answer.taken)
        self._pipeline.send(partial(self._deliver, answer), clean=flows and answer.clean, last=last)

    def _step(self, query: Query) -> _Answer:
        taken: list[NewSample] = []
        self._remark, error, for_good = "", "", False
        outcome: Outcome = "failed"  # used only if the query gives no sample; samples count as an answer
        try:
            check_query(self._own, query)
            if self._approve is not None and not self._approve(query):
                raise StepRefused(NOT_APPROVED)
            self._begun = query
            self._take(query, taken)
        except QueryRefused as refused:
            outcome, error = "refused", str(refused)
        except LeaseEnded as ended:
            outcome, error = "dropped", str(ended)
        except SnapshotGone as gone:
            outcome, error = "impossible", str(gone)
        except StepRefused as refused:
            error, for_good = message_of(refused) or "no reason given", not taken
            outcome = "refused"
        except StepFailed as failed:
            error = message_of(failed) or "no reason given"
            if isinstance(failed, FallbackFailed):
                self._failures.gave_up(error)
        except Exception as raised:  # an environment that runs in this process may raise anything
            error = f"{type(raised).__name__}: {message_of(raised)}"
        except BaseException:  # Ctrl-C: the real steps taken so far are still sent
            self._hand_in(taken)
            self._steps += len(taken)
            raise
        remarks = [self._remark, self._returning.remarks() if self._returning else ""]
        if query.kind == "rollout":
            self._latest.extend(taken)
            remarks.append(undeclared_turns(self._own, list(self._latest), len(taken)))
            latest, now = ([s.seconds for s in of if s.seconds is not None] for of in (self._latest, taken))
            remarks.append(irregular(self._own, latest, len(now)))
        remark = "; ".join(filter(None, remarks))
        return _Answer(query, taken, outcome, error, remark, for_good)

    def _deliver(self, answer: _Answer) -> _Answer:
        """Send the samples of an answer, or return its query if there are none. Returns the answer, changed if the
        server refused the samples."""
        try:
            self._hand_in(answer.taken)
        except InvalidInput as invalid:
            answer = replace(answer, taken=[], outcome="failed", error=str(invalid))
        if not answer.taken:
            if answer.outcome == "impossible":
                # report the snapshot before returning the query, or another sampler would claim the query in vain
                self._report_gone()
            begun = bool(answer.error) and answer.outcome == "failed"
            give_back = partial(
                self._give_back, answer.query, answer.error or STOPPED, begun=begun, refused=answer.for_good
            )
            self._patiently(give_back, LAST_SECONDS)
        return answer

    def _settle(self, answer: _Answer) -> bool:
        """Count a query whose answer was acknowledged. Returns whether it was answered without an error."""
        self._leases.release(answer.query)
        self._steps += len(answer.taken)
        if self._returning is not None:
            self._returning.handed_in([sample.snapshot for sample in answer.taken if sample.snapshot is not None])
        self._report_gone()
        said = "; ".join(filter(None, (answer.error, answer.remark)))
        self._count(answer.query, "answered" if answer.taken else answer.outcome, said, again=not answer.for_good)
        return answer.clean

    def _take(self, query: Query, taken: list[NewSample]) -> None:
        """Take the real steps of a query, and append the sample of each to ``taken`` as soon as the step is done."""
        environment, size = self._environment, len(self._spec.coordinates)
        if isinstance(query, StepQuery):
            assert isinstance(environment, OriginalEnvironment)
            self._leases.check(query)
            step = environment.step_from(np.array(query.coordinates), np.array(query.action))
            taken.append(sample_of(query, step, size))
            return
        assert isinstance(environment, RolloutEnvironment)
        acting = self._acting(query) if query.snapshot is None else None
        self._leases.check(query)
        if query.snapshot is None:
            state = environment.begin(reset_seed(query, self._spec.design.seed))
            self._remark = "; ".join(filter(None, (self._remark, not_declared(self._own, [state]))))
        else:
            assert self._returning is not None  # check_query has refused snapshots if the environment has none
            self._returning.begin(query.snapshot)
            state = np.empty(0)  # only in queries that begin at a reset, actions depend on the state
        ended: float | None = None  # when the step before ended
        for number, expected in enumerate(query.actions):
            if self._stopped():
                return
            self._leases.check(query)
            action = expected if acting is None else acting(state)
            if query.policy is not None and not np.all(np.isfinite(action)):  # no other sampler can do better
                raise StepRefused(f"the policy of the trial chose an action that is no finite number: {action}")
            check_action(self._own, action)
            step = environment.act(np.array(action))
            state = np.asarray(step.next_coordinates, dtype=np.float64)
            before, ended = ended, time.monotonic()
            taken.append(sample_of(query, step, size, number))
            if self._timed and before is not None:
                taken[-1] = taken[-1].model_copy(update={"seconds": ended - before})
            if step.terminated or step.truncated:
                return
            if self._returning is not None:
                snapshot = self._returning.save(taken[-1].next_coordinates)
                taken[-1] = taken[-1].model_copy(update={"snapshot": snapshot})

    def _acting(self, query: RolloutQuery) -> Acting | None:
        """Return a function that chooses an action for a state, if the query asks for one, by its policy or by a
        planner. Return None and set a remark if nothing can be planned here; the expected actions of the query are
        applied then.

        Raises:
            QueryRefused: the policy is not one for this environment.
        """
        if query.policy is not None:
            try:
                return following(b64decode(query.policy), self._own)
            except ValueError as error:
                raise QueryRefused(f"the policy of the trial: {error}") from error
        if not query.replan:
            return None
        if not self._planned:
            self._waits("a planner is made for the next query; the first process on a machine compiles for a minute")
        self._planned = True
        try:
            return replanning(self._api, self._surrogate, self._spec)
        except Exception as error:  # errors of the server's package, whose classes the client does not import
            self._remark = f"the expected actions were applied, because none could be planned anew: {error}"
            return None

    def _report_gone(self) -> None:
        """Tell the server which of its snapshots no longer exist, so that the design chooses other queries."""
        while self._returning is not None and (some := self._returning.gone[:MOST_GONE]):
            self._patiently(partial(self._api.drop_snapshots, self._surrogate, some), LAST_SECONDS)
            del self._returning.gone[: len(some)]

    def _hand_in(self, samples: list[NewSample]) -> None:
        if samples:
            self._patiently(lambda: self._api.add_samples(self._surrogate, self._settings.name, samples), LAST_SECONDS)

    def _patiently(self, request: Callable[[], T], once_stopped: float = 0.0) -> T:
        """Repeat a request until the server and its storage answer. Only requests that are safe to repeat are passed.

        Raises:
            ServerUnreachable, Unavailable: no answer for longer than ``PATIENCE``, or than ``once_stopped`` seconds
                after ``stop``.
        """
        delays, stopped, silent = PATIENCE.delays(), None, True
        while True:
            try:
                return request()
            except AWAY as error:
                pause = next(delays, None)
                if pause is None:
                    raise
                if silent and not self._stopped():
                    self._waits(f"{error}; this sampler tries again for {PATIENCE.seconds / 60:.0f} minutes")
                silent = False
                self._pause(pause)
                if self._stopped():
                    stopped = stopped or time.monotonic()
                    if time.monotonic() - stopped >= once_stopped:
                        raise
                    time.sleep(pause)

    def _stopped(self) -> bool:
        return self._stopping or self._broken_off

    def _pause(self, seconds: float) -> None:
        """Wait for ``seconds``, or until the sampler is stopped."""
        until = time.monotonic() + seconds
        while not self._stopped() and (left := until - time.monotonic()) > 0:
            time.sleep(min(left, LOOK_SECONDS))

    def _give_back(self, query: Query, error: str, *, begun: bool, refused: bool = False) -> None:
        try:
            self._api.fail(self._surrogate, query.id, query.lease_token, error[:4_000], begun=begun, refused=refused)
        except (LeaseExpired, NotThere):
            return  # the lease has ended, so another sampler may have the query

    def _count(self, query: Query, outcome: Outcome, error: str, *, again: bool) -> None:
        if outcome == "refused" and again:  # a query that the server offers again after a refusal is counted once
            if query.id in self._refused:
                return
            self._refused.add(query.id)
        if outcome == "answered":
            self._failures.answered()
        elif outcome == "failed":
            self._failures.failed(query.id, error)
        self._counts[outcome] += 1
        if self._report is not None:
            self._report(query, outcome, error)

    def _limit(self, running: int = 0) -> int:
        """Return the number of queries to claim next; 0 if the sampler has to stop.

        Dropped queries don't count, because other samplers answer them. ``running`` is the number of queries whose
        steps are being taken. Rollouts from resets, which take long, are claimed one by one: others can then be
        withdrawn, or answered by another sampler.
        """
        s = self._settings
        if self._out_of_time():
            return 0
        begun = self._done + self._pipeline.under_way + running
        batch = 1 if self._own.access == "reset" else s.batch
        return batch if s.max_queries is None else min(batch, s.max_queries - begun)

    @property
    def _done(self) -> int:
        return self._counts["answered"] + self._counts["failed"] + self._counts["refused"]

    def _out_of_time(self) -> bool:
        return self._settings.time_limit is not None and self._time_left() <= 0

    def _time_left(self) -> float:
        return self._started + (self._settings.time_limit or 0.0) - time.monotonic()

    def _within_time(self, seconds: float) -> float:
        return seconds if self._settings.time_limit is None else min(seconds, max(0.0, self._time_left()))

    def _enough(self, claimed: ClaimedQueries) -> bool:
        if self._settings.once and claimed.queries:
            return True
        return self._settings.until_done and self._none_allowed(claimed) and claimed.phase in ENDED

    def _none_allowed(self, claimed: ClaimedQueries) -> bool:
        """Return whether a claim returned no queries, or only those that the environment does not allow."""
        return all(query.id in self._refused for query in claimed.queries)
