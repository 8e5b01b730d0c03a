"""HttpSurrogate: implements SurrogatePort for a server, by a stream of frames, or by HTTP with frames or JSON.

It keeps the last requests of a session, which are sent again if the server restores an older checkpoint of it.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, Self, TypeVar, get_args

import numpy as np

from surrogym_client.errors import (
    NoModel,
    ProtocolMismatch,
    SeqConflict,
    SessionLost,
    SurrogymClientError,
    refused_here,
)
from surrogym_client.transport import routes
from surrogym_client.transport.connection import Connection, Retries, Timeouts
from surrogym_client.transport.routes import check_protocol, new_key
from surrogym_client.transport.step_codecs import UNREADABLE, BinaryForm, Form, JsonForm
from surrogym_client.transport.stream import Stream, StreamLost, StreamUnavailable
from surrogym_shared import wire
from surrogym_shared.codes import STATUS, Code, Problem
from surrogym_shared.frames import Shape
from surrogym_shared.port import Bools, Floats, Ints, PolicyRollout, ResetResult, StepResult
from surrogym_shared.spec import EnvironmentSpec

if TYPE_CHECKING:
    from surrogym_shared.acting import ActingPolicy, NoiseKey

MAX_BYTES = 32 * 2**20


@dataclass(frozen=True)
class Sent:
    """A request of a session, and the digest of its answer once it has been answered."""

    seq: int
    what: str
    content: bytes = field(repr=False)
    read: Callable[[bytes, Shape], tuple[int, Any]]
    timeout: float
    digest: bytes = b""


class ResendBuffer:
    """Buffer of the last answered requests of a session, in order.

    Args:
        most: number of requests to keep. Their contents take at most 32 MiB together.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._sent: deque[Sent] = deque()
        self._bytes = 0

    def keep(self, sent: Sent) -> None:
        self._sent.append(sent)
        self._bytes += len(sent.content)
        while len(self._sent) > self._most or self._bytes > MAX_BYTES:
            self._bytes -= len(self._sent.popleft().content)

    def since(self, seq: int) -> list[Sent] | None:
        """Return the requests from number ``seq`` on; None if the first of these requests are no longer kept."""
        if not self._sent or self._sent[0].seq > seq:
            return None
        return [sent for sent in self._sent if sent.seq >= seq]


def digest_of(answer: bytes) -> bytes:
    return hashlib.blake2b(answer, digest_size=16).digest()


Transport = Literal["auto", "stream", "binary", "json"]
T = TypeVar("T")

_RETURNS = 5  # how often a server may go back to an older checkpoint (saved state) of a session during one request
_UPGRADE_PAUSE_SECONDS = 60.0  # pause before a stream is tried again, after one was refused or broke without an answer


@dataclass
class _Live:
    """Client's record of an open session. ``seq`` is the number of the last answered request."""

    route: str
    shape: Shape
    seq: int
    stream: Stream
    # The last requests, to send them again if the server goes back to an older saved state; None: it never does.
    window: ResendBuffer | None


class HttpSurrogate:
    """One surrogate on a server, as a ``SurrogatePort`` over HTTP or a WebSocket.

    After a lost reply, a time-out or a dropped connection, the same request is sent again with the same sequence
    number, so a step happens once. A session is an id, not a connection: another HttpSurrogate may continue it, and a
    pickled copy opens its own connection. Two clients can't step one session at once: the second gets ``SeqConflict``.

    Args:
        url: the server's address; default ``SURROGYM_URL``, then http://127.0.0.1:8000.
        surrogate: name of the surrogate.
        token: bearer token; default ``SURROGYM_TOKEN``, then the one in the file ``SURROGYM_TOKEN_FILE``.
        timeouts: seconds for each kind of request.
        retries: how long to retry after lost connections, lost replies and status 503.
        transport: how reset, step and rollout travel. ``stream`` is the fastest: binary frames over a WebSocket.
            ``binary`` sends the same frames over HTTP, ``json`` text that a person can read. ``auto`` uses the stream,
            and frames over HTTP if the stream is refused or never answers.

    Raises:
        ValueError: an unknown transport.
        SurrogymClientError: every method; see ``surrogym_client.errors``.

    Examples:
        >>> with HttpSurrogate(None, "pendulum") as surrogate:
        ...     session = surrogate.open(OpenSession(num_envs=4, seed=0))
        ...     start = surrogate.reset(session.id)
        ...     result = surrogate.step(session.id, np.zeros((4, 1)))
    """

    def __init__(
        self,
        url: str | None,
        surrogate: str,
        token: str | None = None,
        *,
        timeouts: Timeouts | None = None,
        retries: Retries | None = None,
        transport: Transport = "auto",
    ) -> None:
        if transport not in get_args(Transport):
            raise ValueError(f"transport: expected one of {', '.join(get_args(Transport))}, got {transport!r}")
        self.surrogate = surrogate
        self.connection = Connection(url, token, timeouts, retries)
        self.transport: Transport = transport
        self._form: Form = JsonForm() if transport == "json" else BinaryForm()
        self._live: dict[str, _Live] = {}
        # Until this time, as of time.monotonic, requests are sent over HTTP, and no stream is opened.
        self._upgrade_after = math.inf if self.connection.proxied else 0.0
        self._streamed = False  # whether any stream has returned an answer
        self._spec: EnvironmentSpec | None = None

    def __repr__(self) -> str:
        return f"HttpSurrogate({self.connection.url!r}, {self.surrogate!r})"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.disconnect()

    def disconnect(self) -> None:
        """Close the sockets. Sessions remain until ``close`` or their expiry, and a later request connects again."""
        for live in list(self._live.values()):
            live.stream.close()
        self.connection.close()

    def spec(self) -> EnvironmentSpec:
        if self._spec is None:
            self._spec = self.connection.get(wire.SurrogateView, self._route).spec
        return self._spec

    def model_file(self) -> bytes:
        view = self.connection.get(wire.SurrogateView, self._route)
        if view.model_version is None:
            detail = f"{self.surrogate!r} has no model yet: let a sampler answer its first queries, or import a log"
            raise NoModel(Problem(title="No model", status=STATUS[Code.NO_MODEL], code=Code.NO_MODEL, detail=detail))
        route = f"{self._route}/models/{view.model_version}"
        return self.connection.send("GET", route, params={"format": "safetensors"})

    def open(self, request: wire.OpenSession) -> wire.SessionView:
        if request.idempotency_key is None:
            request = request.model_copy(update={"idempotency_key": new_key()})
        timeout = self.connection.timeouts.open
        view = self.connection.post(wire.SessionView, f"{self._route}/sessions", request, timeout=timeout)
        check_protocol(view.protocol, self.connection.url)
        self._know(view)
        return view

    def reset(self, session: str, *, seed: int | Sequence[int] | None = None, mask: Bools | None = None) -> ResetResult:
        return self._in_sequence(
            session,
            "reset",
            lambda seq, shape: self._form.reset(seq, seed, mask, shape),
            self._form.read_reset,
            self.connection.timeouts.step,
        )

    def step(
        self, session: str, action: Floats | Ints, *, mask: Bools | None = None, deviations: bool = False
    ) -> StepResult:
        return self._in_sequence(
            session,
            "step",
            lambda seq, shape: self._form.step(seq, action, mask, deviations, shape),
            self._form.read_step,
            self.connection.timeouts.step,
        )

    def rollout(self, session: str, actions: Floats | Ints) -> list[StepResult]:
        return self._in_sequence(
            session,
            "rollout",
            lambda seq, shape: self._form.rollout(seq, np.asarray(actions), shape),
            self._form.read_rollout,
            self.connection.timeouts.rollout,
        )

    def rollout_policy(
        self,
        session: str,
        policy: ActingPolicy,
        steps: int,
        *,
        noise: NoiseKey | None = None,
        until: Bools | None = None,
    ) -> PolicyRollout:
        from surrogym_shared.acting import PolicyRun  # imported late: steps do not need it

        try:
            run = PolicyRun(policy, steps, noise, until)
        except ValueError as error:
            raise refused_here(Code.INVALID_REQUEST, str(error)) from error
        return self._in_sequence(
            session,
            "rollout",
            lambda seq, shape: self._form.policy(seq, run, shape),
            self._form.read_policy,
            self.connection.timeouts.rollout,
        )

    def submit_occupancy(self, session: str, checkpoint: str) -> wire.SubmittedOccupancy:
        route = f"{routes.session(session)}/occupancy"
        return self.connection.post(wire.SubmittedOccupancy, route, wire.SubmitOccupancy(checkpoint=checkpoint))

    def close(self, session: str) -> None:
        """Close the session. Closing the last session also closes the sockets."""
        self._forget(session)
        try:
            with suppress(SessionLost):
                self.connection.send("DELETE", routes.session(session), retries=Retries(seconds=0))
        finally:
            if not self._live:
                self.disconnect()

    @property
    def _route(self) -> str:
        return routes.surrogate(self.surrogate)

    def _in_sequence(
        self,
        session: str,
        what: str,
        write: Callable[[int, Shape], bytes],
        read: Callable[[bytes, Shape], tuple[int, T]],
        timeout: float,
    ) -> T:
        """Send the request ``what``, which changes the session, and return its result. ``write`` makes the body from
        the sequence number; ``read`` parses the reply. If the request fails, the next one has the same number."""
        live = self._live.get(session) or self._look_up(session)
        sent = Sent(live.seq + 1, what, write(live.seq + 1, live.shape), read, timeout)
        result: T
        try:
            answer, (seq, result) = self._answered(live, sent)
        except SessionLost:
            self._forget(session)
            raise
        except UNREADABLE as error:
            live.stream.close()
            raise ProtocolMismatch(
                f"the server's answer to {live.route}/{what} can't be read: {error}; upgrade the older of client and "
                "server"
            ) from error
        if seq != live.seq + 1:
            live.stream.close()
            raise ProtocolMismatch(
                f"expected the answer to request {live.seq + 1} of session {session}, got the one to request {seq}: "
                "open a new session"
            )
        live.seq = seq
        if live.window is not None:
            live.window.keep(replace(sent, digest=digest_of(answer)))
        return result

    def _answered(self, live: _Live, sent: Sent) -> tuple[bytes, tuple[int, Any]]:
        """Send a request until it is answered. If the server has restored an older checkpoint of the session, first
        send the requests after this checkpoint again."""
        if live.window is None:
            return self._sent(live, sent)
        window, returns = live.window, 0
        while True:
            try:
                return self._sent(live, sent)
            except SeqConflict as conflict:
                behind = conflict.expected_seq
                if behind is None or behind >= sent.seq or returns == _RETURNS:
                    raise
                returns += 1
                # If the server restores an older checkpoint meanwhile, resend the requests once more.
                with suppress(SeqConflict):
                    self._send_again(live, window, behind)

    def _send_again(self, live: _Live, window: ResendBuffer, behind: int) -> None:
        """Send the requests from number ``behind`` on again. Their answers must be the same as before, bit for bit."""
        if (missing := window.since(behind)) is None:
            raise self._given_up(
                live,
                f"the process that took the session over needs the requests from number {behind} on again, which this "
                "client no longer keeps",
            )
        for sent in missing:
            answer, _ = self._sent(live, sent)
            if digest_of(answer) != sent.digest:
                raise self._given_up(
                    live,
                    f"the process that took the session over answers the repeated request {sent.seq} differently than "
                    "the process before",
                )

    def _given_up(self, live: _Live, what: str) -> SurrogymClientError:
        with suppress(SurrogymClientError):
            self.connection.send("DELETE", live.route, retries=Retries(seconds=0))
        return refused_here(
            Code.UNKNOWN_SESSION,
            f"the server process that held the session has ended, and {what}: open a new session",
        )

    def _sent(self, live: _Live, sent: Sent) -> tuple[bytes, tuple[int, Any]]:
        attempt = self._attempt(live, sent.what, sent.content, sent.timeout)

        def once() -> tuple[bytes, tuple[int, Any]]:
            answer = attempt()
            return answer, sent.read(answer, live.shape)

        return self.connection.persist(once)

    def _attempt(self, live: _Live, what: str, content: bytes, timeout: float) -> Callable[[], bytes]:
        """Return a function that sends a request once, by the stream or by HTTP. After a failure it is called again."""
        if self.transport == "stream":
            return lambda: live.stream.exchange(content, timeout)
        by_http = self.connection.attempt(
            "POST", f"{live.route}/{what}", content, timeout=timeout, media_type=self._form.media_type
        )
        if self.transport != "auto" or time.monotonic() < self._upgrade_after:
            return by_http
        first = True

        def stream_first() -> bytes:
            """Send a request by the stream, and if it is repeated, by HTTP: the request that broke the stream may break
            it again, and HTTP returns the reason."""
            nonlocal first
            if not first:
                return by_http()
            first = False
            try:
                answer = live.stream.exchange(content, timeout)
                self._streamed = True
            except StreamUnavailable:
                answer = by_http()
                self._avoid_stream(_UPGRADE_PAUSE_SECONDS)
            except StreamLost:
                if not self._streamed:
                    self._avoid_stream(_UPGRADE_PAUSE_SECONDS)
                raise
            except TimeoutError:
                if not self._streamed:
                    # A proxy opened the stream, but passes no messages, so later requests would time out too.
                    self._avoid_stream(math.inf)
                raise
            return answer

        return stream_first

    def _avoid_stream(self, seconds: float) -> None:
        self._upgrade_after = time.monotonic() + seconds

    def _look_up(self, session: str) -> _Live:
        """Ask the server for a session that another client opened, and start to track it."""
        return self._know(self.connection.get(wire.SessionView, routes.session(session)))

    def _know(self, view: wire.SessionView) -> _Live:
        route = routes.session(view.id)
        stream = self.connection.stream_to(f"{route}/stream")
        window = ResendBuffer(view.replay) if view.replay else None
        self._live[view.id] = _Live(route, Shape.of(view), view.seq, stream, window)
        return self._live[view.id]

    def _forget(self, session: str) -> None:
        if live := self._live.pop(session, None):
            live.stream.close()
