"""The worker beside the original environment: claims queries, takes the real step, hands in what happened."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from types import TracebackType
from typing import Literal, Self, TypeVar

import numpy as np

from surrogym_client.answers import reset_seed, sample_of
from surrogym_client.api import Api
from surrogym_client.connection import Retries
from surrogym_client.errors import (
    InvalidInput,
    LeaseExpired,
    NotThere,
    ServerUnreachable,
    SurrogymClientError,
    Unavailable,
)
from surrogym_client.original.errors import StepFailed, UnknownEnvironment
from surrogym_client.original.protocol import Environment, OriginalEnvironment, RolloutEnvironment
from surrogym_client.original.rollouts import answering
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import ClaimedQueries, NewSample, Phase, Query, StepQuery

FINISHED: tuple[Phase, ...] = ("ready", "over_budget", "failed")
PATIENCE = Retries(seconds=900.0, first_delay=0.1, longest_delay=5.0)  # with a server or a storage that is away
LOOK_SECONDS = 0.1  # how often a worker that waits looks whether it was stopped
LAST_SECONDS = 5.0  # a sampler that was stopped asks on for so long, with a real step that is not handed in yet
AWAY = (ServerUnreachable, Unavailable)
STOPPED = "the sampler was stopped"

T = TypeVar("T")
Outcome = Literal["answered", "failed"]


def worker_name() -> str:
    """A name that tells this worker from others in the ledger."""
    return f"{socket.gethostname()}-{os.getpid()}"[:128]


@dataclass(frozen=True)
class SamplerSettings:
    """How a worker works.

    ``batch``: queries claimed at once. ``until_done``: stop when the design has reached its target or its budget;
    ``once``: stop after the first claim that gives any; ``max_queries`` and ``time_limit`` (seconds) stop it too.
    """

    name: str = field(default_factory=worker_name)
    batch: int = 4
    wait_seconds: float = 20.0
    lease_seconds: float = 60.0
    once: bool = False
    until_done: bool = False
    max_queries: int | None = None
    time_limit: float | None = None


@dataclass(frozen=True)
class SamplerReport:
    """What a worker did. ``phase`` is the last one the server told."""

    answered: int
    failed: int
    steps: int  # real ones, handed in
    seconds: float
    phase: Phase | None


class Sampler:
    """Answers the queries of one surrogate.

    A step that fails gives its query back with the error; in a rollout, the steps before it are the answer. A server
    that is away is waited for, and an answer is not given up meanwhile.

    Args:
        api: the server.
        surrogate: its name there.
        environment: the original environment; wrap it into ``IsolatedEnvironment`` where it may hang or crash.
        settings: when to stop, how much to claim.
        report: called after every query with it, what became of it, and the error if there was one.

    Example:
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
    ) -> None:
        self._api = api
        self._surrogate = surrogate
        self._environment = environment
        self._settings = settings or SamplerSettings()
        self._report = report
        self._counts: dict[Outcome, int] = {"answered": 0, "failed": 0}
        self._steps = 0
        self._phase: Phase | None = None
        self._spec: EnvironmentSpec
        self._started = time.monotonic()
        self._stopping = False  # no Event: a signal handler that sets one may wait for itself

    def stop(self) -> None:
        """End ``run`` after the step that is under way; for another thread, or a signal handler. A server that is away
        is waited for no longer, but some seconds with a real step that it has not got yet; what ``api`` itself repeats
        of one request (``Retries``) comes on top."""
        self._stopping = True

    def run(self) -> SamplerReport:
        """Work until a setting says stop, ``stop`` is called, or Ctrl-C comes.

        Raises:
            UnknownSurrogate: there is none of this name, or it was deleted.
            ServerUnreachable, Unavailable: the server, or its storage, stayed away for too long.
            UnknownEnvironment: the environment can't be made, or is another one than the surrogate's.
        """
        self._started = time.monotonic()
        self._check()
        with Heartbeat(self._api, self._surrogate, self._settings.lease_seconds) as heartbeat:
            while not self._stopped() and (limit := self._limit()) > 0:
                try:
                    claimed = self._patiently(partial(self._claim, limit))
                except AWAY:
                    if self._stopped():
                        break
                    raise
                self._phase = claimed.phase
                self._work(claimed.queries, heartbeat)
                if self._enough(claimed):
                    break
        return self.summary()

    def summary(self) -> SamplerReport:
        """What was done so far."""
        seconds = time.monotonic() - self._started
        return SamplerReport(self._counts["answered"], self._counts["failed"], self._steps, seconds, self._phase)

    def _check(self) -> None:
        """Refuse an environment whose coordinates, action or kind of query are not the surrogate's."""
        self._environment = answering(self._environment)
        asked, own = self._api.surrogate(self._surrogate).spec, self._environment.spec()
        expected, got = _shape(asked), _shape(own)
        if expected != got:
            raise UnknownEnvironment(
                f"the environment does not fit surrogate {self._surrogate!r}: expected {expected}, got {got}"
            )
        self._spec = asked

    def _claim(self, limit: int) -> ClaimedQueries:
        s = self._settings
        waits = not (s.until_done and (self._phase is None or self._phase in FINISHED))
        left = s.wait_seconds if s.time_limit is None else min(s.wait_seconds, max(0.0, self._time_left()))
        return self._api.claim(
            self._surrogate,
            s.name,
            max_queries=limit,
            wait_seconds=left if waits else 0.0,
            lease_seconds=s.lease_seconds,
        )

    def _work(self, queries: list[Query], heartbeat: Heartbeat) -> None:
        """Answer queries one by one; those left when a person interrupts are given back."""
        left, begun = list(queries), None
        heartbeat.hold(left)
        try:
            while left and not self._stopped():
                begun = left[0]
                self._answer(begun)
                heartbeat.release(left.pop(0))
        finally:
            for query in left:
                heartbeat.release(query)
                self._give_back(query, STOPPED, begun=query is begun)

    def _answer(self, query: Query) -> None:
        taken: list[NewSample] = []
        error = ""
        try:
            self._take(query, taken)
        except StepFailed as failed:
            error = str(failed) or "no reason given"
        except Exception as raised:  # an environment that is not isolated may raise anything
            error = f"{type(raised).__name__}: {raised}"
        except BaseException:  # a person interrupts: what was done to the original environment is told all the same
            self._hand_in(taken)
            raise
        try:
            self._hand_in(taken)
        except InvalidInput as refused:
            taken, error = [], str(refused)
        if taken:
            self._count(query, "answered", error)
        else:
            self._fail(query, error or STOPPED, begun=bool(error))

    def _take(self, query: Query, taken: list[NewSample]) -> None:
        """Take the real steps of a query, and put each into ``taken`` as soon as it is done."""
        environment, size = self._environment, len(self._spec.coordinates)
        if isinstance(query, StepQuery):
            assert isinstance(environment, OriginalEnvironment)
            step = environment.step_from(np.array(query.coordinates), np.array(query.action))
            taken.append(sample_of(query, step, size))
            return
        assert isinstance(environment, RolloutEnvironment)
        environment.begin(reset_seed(query, self._spec.design.seed))
        for number, action in enumerate(query.actions):
            if self._stopped():
                return
            step = environment.act(np.array(action))
            taken.append(sample_of(query, step, size, number))
            if step.terminated or step.truncated:
                return

    def _hand_in(self, samples: list[NewSample]) -> None:
        if samples:
            self._patiently(lambda: self._api.add_samples(self._surrogate, self._settings.name, samples), LAST_SECONDS)
            self._steps += len(samples)

    def _fail(self, query: Query, error: str, *, begun: bool) -> None:
        self._patiently(lambda: self._give_back(query, error, begun=begun), LAST_SECONDS)
        self._count(query, "failed", error)

    def _patiently(self, request: Callable[[], T], once_stopped: float = 0.0) -> T:
        """Ask until the server and its storage are back; every request here may be repeated.

        Raises:
            ServerUnreachable, Unavailable: they stayed away for longer than ``PATIENCE``, or than ``once_stopped``
                seconds after ``stop``.
        """
        delays, stopped = PATIENCE.delays(), None
        while True:
            try:
                return request()
            except AWAY:
                pause = next(delays, None)
                if pause is None:
                    raise
                self._pause(pause)
                if self._stopped():
                    stopped = stopped or time.monotonic()
                    if time.monotonic() - stopped >= once_stopped:
                        raise
                    time.sleep(pause)

    def _stopped(self) -> bool:
        return self._stopping

    def _pause(self, seconds: float) -> None:
        """Wait for so long, or until this worker is stopped."""
        until = time.monotonic() + seconds
        while not self._stopped() and (left := until - time.monotonic()) > 0:
            time.sleep(min(left, LOOK_SECONDS))

    def _give_back(self, query: Query, error: str, *, begun: bool) -> None:
        try:
            self._api.fail(self._surrogate, query.id, query.lease_token, error[:4_000], begun=begun)
        except (LeaseExpired, NotThere):
            return  # the query has gone to the next one already

    def _count(self, query: Query, outcome: Outcome, error: str) -> None:
        self._counts[outcome] += 1
        if self._report is not None:
            self._report(query, outcome, error)

    def _limit(self) -> int:
        """How many queries to claim next; 0 when it is time to stop."""
        s = self._settings
        if s.time_limit is not None and self._time_left() <= 0:
            return 0
        return s.batch if s.max_queries is None else min(s.batch, s.max_queries - sum(self._counts.values()))

    def _time_left(self) -> float:
        return self._started + (self._settings.time_limit or 0.0) - time.monotonic()

    def _enough(self, claimed: ClaimedQueries) -> bool:
        if self._settings.once and claimed.queries:
            return True
        return self._settings.until_done and not claimed.queries and claimed.phase in FINISHED


class Heartbeat:
    """Renews the leases that a worker holds, from a thread of its own, at a third of their length."""

    def __init__(self, api: Api, surrogate: str, lease_seconds: float) -> None:
        self._api = api
        self._surrogate = surrogate
        self._lease_seconds = lease_seconds
        self._held: dict[int, Query] = {}
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.set()
        self._thread.join(timeout=5.0)

    def hold(self, queries: list[Query]) -> None:
        with self._lock:
            self._held.update({query.id: query for query in queries})

    def release(self, query: Query) -> None:
        with self._lock:
            self._held.pop(query.id, None)

    def _beat(self) -> None:
        while not self._ending.wait(self._lease_seconds / 3):
            with self._lock:
                held = list(self._held.values())
            for query in held:
                self._renew(query)

    def _renew(self, query: Query) -> None:
        try:
            self._api.renew(self._surrogate, query.id, query.lease_token, lease_seconds=self._lease_seconds)
        except AWAY:
            return  # the next beat tries again
        except SurrogymClientError:
            self.release(query)  # a late answer is still a true observation, so the step goes on


def _shape(spec: EnvironmentSpec) -> str:
    names = ", ".join(spec.coordinate_names)
    return f"coordinates ({names}), a {spec.action.kind} action of {spec.action.size}, and {spec.query} queries"
