"""Connection to one server over HTTP. It handles time-outs, retries and errors of every request in the same way."""

from __future__ import annotations

import os
import random
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from ssl import SSLContext
from threading import Lock
from typing import Any, Self, TypeVar
from urllib.request import getproxies, proxy_bypass

import httpx
from pydantic import BaseModel, ValidationError

from surrogym_client.errors import (
    ProtocolMismatch,
    RequestTimeout,
    ServerUnreachable,
    SurrogymClientError,
    Unavailable,
    UnusableCertificates,
    UnusableToken,
    error_from_problem,
)
from surrogym_client.transport.routes import parse
from surrogym_client.transport.stream import Stream, StreamUnavailable
from surrogym_shared.codes import Problem
from surrogym_shared.patterns import IN_WORDS, TOKEN
from surrogym_shared.wire import Reply

T = TypeVar("T")
R = TypeVar("R", bound=Reply)

JSON = "application/json"
DEFAULT_URL = "http://127.0.0.1:8000"
URL_VARIABLE = "SURROGYM_URL"
TOKEN_VARIABLE = "SURROGYM_TOKEN"
TOKEN_FILE_VARIABLE = "SURROGYM_TOKEN_FILE"

_NOT_SENT = (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout, StreamUnavailable)
_TIMEOUTS = (httpx.TimeoutException, TimeoutError)
_GATEWAY_STATUSES = (502, 503, 504)
MOST_ANSWER = 512 * 2**20  # largest answer in bytes, decompressed; twice as large as the largest file of a surrogate
_KEEPALIVE_SECONDS = 3.0  # idle connections are kept for this time; the server closes them after 5 s


@dataclass(frozen=True)
class Timeouts:
    """Seconds to wait for the answer to each kind of request, before it is retried."""

    connect: float = 5.0
    request: float = 30.0
    step: float = 60.0
    rollout: float = 600.0
    open: float = 150.0  # time to open a session, because a newly installed server compiles its code first


@dataclass(frozen=True)
class Retries:
    """Retry budget of a request: ``seconds`` from the first failure; 0 does not retry.

    Pauses grow by ``factor``. The actual pause is drawn at random between half of this length and all of it.
    """

    seconds: float = 30.0
    first_delay: float = 0.05
    longest_delay: float = 2.0
    factor: float = 2.0

    def delays(self) -> Iterator[float]:
        """Iterate over the pauses between attempts, in seconds, until the time for retries has passed."""
        if self.seconds <= 0:
            return
        deadline = time.monotonic() + self.seconds
        delay = self.first_delay
        while (left := deadline - time.monotonic()) > 0:
            yield min(left, delay * random.uniform(0.5, 1.0))
            delay = min(self.longest_delay, delay * self.factor)


ONE_ATTEMPT = Retries(seconds=0)  # for requests that are repeated later anyway
AWAY = (ServerUnreachable, Unavailable)  # errors after which a later attempt may succeed


class Connection:
    """Sends requests to one server. It is safe to share between threads, and a pickled copy opens its own connection.

    Args:
        url: the server's address; default ``SURROGYM_URL``, then http://127.0.0.1:8000.
        token: bearer token; default ``SURROGYM_TOKEN``, then the one in the file ``SURROGYM_TOKEN_FILE``.
        timeouts: seconds for each kind of request.
        retries: how long to retry after lost connections, lost replies and status 503.

    Raises:
        ServerUnreachable: ``url`` is not a valid address.
        UnusableToken: the token file can't be used, or no header can contain the token.
        UnusableCertificates: the file ``SSL_CERT_FILE`` can't be used.
    """

    def __init__(
        self,
        url: str | None = None,
        token: str | None = None,
        timeouts: Timeouts | None = None,
        retries: Retries | None = None,
    ) -> None:
        self.url = _checked(url or os.environ.get(URL_VARIABLE) or DEFAULT_URL)
        self.timeouts = timeouts or Timeouts()
        self.retries = retries or Retries()
        self._token = _sendable(token if token is not None else _token_of_environment())
        self._connect()

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key not in ("_client", "_trusted", "_lock")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._connect()

    def _connect(self) -> None:
        self._trusted = _trusted_certificates()  # kept for later clients, because it takes 20 ms to read
        self._client = _new_client(self.url, self._token, self._trusted)
        self._lock, self._under_way, self._closing = Lock(), 0, False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the sockets, also of streams; but while other threads have requests under way, the last of them does.

        Sessions and leases on the server remain. A later request connects again; then close the sockets again.
        """
        with self._lock:
            self._closing = True
            self._close_unused()

    def get(self, reply: type[R], path: str, **params: str | int) -> R:
        """Send a GET request, and return the answer as its wire model. Raises the errors of ``send``."""
        return parse(reply, self.send("GET", path, params=params or None), path)

    def post(
        self,
        reply: type[R],
        path: str,
        body: BaseModel | None = None,
        *,
        method: str = "POST",
        timeout: float | None = None,
        repeatable: bool = True,
        retries: Retries | None = None,
    ) -> R:
        """Send a request with a wire model as its body, and return the answer as its wire model. The other arguments
        and the errors are those of ``send``."""
        content = None if body is None else body.model_dump_json().encode()
        return parse(
            reply, self.send(method, path, content, timeout=timeout, repeatable=repeatable, retries=retries), path
        )

    def send(
        self,
        method: str,
        path: str,
        body: bytes | None = None,
        *,
        params: Mapping[str, str | int] | None = None,
        timeout: float | None = None,
        media_type: str = JSON,
        repeatable: bool = True,
        retries: Retries | None = None,
    ) -> bytes:
        """Send a request, retry it until it is answered, and return the body of the answer.

        Args:
            method: HTTP method.
            path: route, with its leading slash.
            body: bytes of the media type.
            params: query parameters.
            timeout: seconds to wait for the answer; None takes ``timeouts.request``.
            media_type: media type of the body.
            repeatable: whether the request may be sent again after a lost reply, because carrying it out twice is
                harmless.
            retries: retry budget that replaces the connection's.

        Raises:
            ServerUnreachable: no connection, or every reply was lost, within the retry budget.
            RequestTimeout: the last attempt was not answered in time.
            ProtocolMismatch: the answer is not a Surrogym server's.
            ProblemError: the server refused; its subclass says why.
        """
        attempt = self.attempt(method, path, body, params=params, timeout=timeout, media_type=media_type)
        return self.persist(attempt, repeatable=repeatable, retries=retries)

    def attempt(
        self,
        method: str,
        path: str,
        body: bytes | None = None,
        *,
        params: Mapping[str, str | int] | None = None,
        timeout: float | None = None,
        media_type: str = JSON,
    ) -> Callable[[], bytes]:
        """Return a function that sends a request once, for ``persist``. The arguments are those of ``send``."""

        def send_once() -> bytes:
            with self._open_client() as client:
                request = client.build_request(
                    method,
                    self.url + path,
                    content=body,
                    params=params,
                    headers={"Content-Type": media_type, "Accept": media_type},
                    timeout=self._timeout(timeout),
                )
                response = client.send(request, stream=True)
                try:
                    return _body(response, _content(response))
                finally:
                    response.close()

        return send_once

    def persist(self, attempt: Callable[[], T], *, repeatable: bool = True, retries: Retries | None = None) -> T:
        """Call ``attempt`` until it succeeds, the server refuses it, or the pauses of ``retries`` are used up.

        Args:
            attempt: sends one request.
            repeatable: whether the server may get the request twice. If not, it is sent again only if it certainly did
                not arrive.
            retries: pauses between attempts; None takes the connection's.

        Raises:
            ServerUnreachable, Unavailable: the last attempt failed.
            ProblemError: the server refused the request.
        """
        delays: Iterator[float] | None = None
        while True:
            try:
                return attempt()
            except (httpx.TransportError, OSError, Unavailable) as failure:
                # The connection of a failed request is closed, so that its late reply is not read for another request.
                delays = (retries or self.retries).delays() if delays is None else delays
                pause = next(delays, None) if repeatable or isinstance(failure, (*_NOT_SENT, Unavailable)) else None
                if pause is None:
                    raise _given_up(failure, self.url) from None
                time.sleep(pause)

    @property
    def proxied(self) -> bool:
        """Whether requests pass a proxy from the environment variables, which carries HTTP but no stream."""
        url = httpx.URL(self.url)
        return not _is_loopback(self.url) and url.scheme in getproxies() and not proxy_bypass(url.host)

    def stream_to(self, path: str) -> Stream:
        """Return a stream of messages with this server. It connects on first use."""
        return Stream(self.url + path, self._token, self.timeouts.connect)

    @contextmanager
    def stream(self, path: str, headers: Mapping[str, str], idle_seconds: float) -> Iterator[Iterator[str]]:
        """Open a stream of text lines. After ``idle_seconds`` without a line, the connection counts as lost.

        Raises:
            ServerUnreachable: the connection failed or broke.
            ProblemError: the server refused.
        """
        try:
            with self._open_client() as client:
                request = client.build_request(
                    "GET", self.url + path, headers=dict(headers), timeout=self._timeout(idle_seconds)
                )
                response = client.send(request, stream=True)
            try:
                if response.is_error:
                    _body(response, _content(response))
                yield response.iter_lines()
            finally:
                response.close()
        except httpx.TransportError as failure:
            raise _given_up(failure, self.url) from None

    @contextmanager
    def _open_client(self) -> Iterator[httpx.Client]:
        """Open client for one request, or for the opening of a stream. It is not closed before that has ended, because
        httpx would lose the socket of a request that is just connecting."""
        with self._lock:
            if self._client.is_closed:
                self._client, self._closing = _new_client(self.url, self._token, self._trusted), False
            self._under_way += 1
            client = self._client
        try:
            yield client
        finally:
            with self._lock:
                self._under_way -= 1
                self._close_unused()

    def _close_unused(self) -> None:
        if self._closing and not self._under_way:
            self._client.close()

    def _timeout(self, seconds: float | None) -> httpx.Timeout:
        return httpx.Timeout(seconds or self.timeouts.request, connect=self.timeouts.connect)


def token_in(path: Path) -> str:
    """Read the token from a file with one line, in the form that ``surrogym serve --token-file`` accepts too.

    Raises:
        UnusableToken: the file can't be read, or does not contain exactly one token.
    """
    from surrogym_shared.secret_files import tokens_in  # imported here, because only a token file needs it

    try:
        tokens = tokens_in(path)
    except OSError as error:
        raise UnusableToken(
            f"the token file {str(path)!r} can't be read: {error.strerror}; check its path and permissions"
        ) from error
    except ValueError as error:
        raise UnusableToken(f"the token file {str(path)!r} can't be used: {error}") from None
    if len(tokens) != 1:
        raise UnusableToken(
            f"the token file {str(path)!r}: expected one token, got {len(tokens)}: write a single line with one"
        )
    return next(iter(tokens))


def _token_of_environment() -> str | None:
    file = os.environ.get(TOKEN_FILE_VARIABLE)
    return os.environ.get(TOKEN_VARIABLE) or (token_in(Path(file)) if file else None)


def _sendable(token: str | None) -> str | None:
    """Return a token that a header can contain. Else raise an error that does not show the token."""
    if token and not re.fullmatch(TOKEN, token):
        raise UnusableToken(f"a token: expected {IN_WORDS[TOKEN]}, got other characters: correct it where you set it")
    return token


def _checked(url: str) -> str:
    try:
        parsed = httpx.URL(url)
    except httpx.InvalidURL as error:
        raise ServerUnreachable(f"expected a server address like {DEFAULT_URL}, got {url!r}: {error}") from error
    if parsed.scheme not in ("http", "https") or not parsed.host:
        raise ServerUnreachable(f"expected a server address like {DEFAULT_URL}, got {url!r}")
    if parsed.userinfo:  # a password in the URL would be written into cards and reports, and sent instead of the token
        raise ServerUnreachable(
            f"expected an address without user and password, got both for {parsed.host!r}: give a token instead"
        )
    return url.rstrip("/")


def _trusted_certificates() -> SSLContext:
    try:
        # reads SSL_CERT_FILE also for loopback hosts, for which trust_env is false
        return httpx.create_ssl_context()
    except OSError as error:
        file = os.environ.get("SSL_CERT_FILE")
        raise UnusableCertificates(
            f"SSL_CERT_FILE: expected a file of trusted certificates in PEM, got {file!r}: {error.strerror or error}"
        ) from error


def _new_client(url: str, token: str | None, trusted: SSLContext) -> httpx.Client:
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    limits = httpx.Limits(keepalive_expiry=_KEEPALIVE_SECONDS)
    return httpx.Client(headers=headers, limits=limits, verify=trusted, trust_env=not _is_loopback(url))


def _is_loopback(url: str) -> bool:
    """Whether the host of a URL is this machine, to which requests never pass a proxy."""
    host = httpx.URL(url).host
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _content(response: httpx.Response) -> bytes:
    """Read and decompress an answer, and no more than ``MOST_ANSWER`` bytes of it."""
    parts, size = [], 0
    try:
        for part in response.iter_bytes():
            size += len(part)
            if size > MOST_ANSWER:
                raise ProtocolMismatch(
                    f"expected an answer of at most {MOST_ANSWER} bytes from {response.url}, got more: check the "
                    "address"
                )
            parts.append(part)
    except httpx.DecodingError:
        raise ProtocolMismatch(
            f"expected an answer that can be decompressed from {response.url}, got another: check the address"
        ) from None
    return b"".join(parts)


def _body(response: httpx.Response, content: bytes) -> bytes:
    kind = response.headers.get("content-type", "")
    if response.is_success and not kind.startswith("text/html"):
        return content
    try:
        problem = Problem.model_validate_json(content)
    except ValidationError:
        if response.status_code in _GATEWAY_STATUSES:
            raise httpx.RemoteProtocolError(
                f"expected an answer of the server, got status {response.status_code} from a gateway in front of it: "
                "try again later"
            ) from None
        raise ProtocolMismatch(
            f"expected a Surrogym server at {response.url}, got an answer with status {response.status_code} and "
            f"content type {kind or 'unknown'!r}: check the address"
        ) from None
    raise error_from_problem(problem)


def _given_up(failure: Exception, url: str) -> SurrogymClientError:
    if isinstance(failure, SurrogymClientError):
        return failure
    if isinstance(failure, _NOT_SENT):
        return ServerUnreachable(f"no Surrogym server answers at {url} ({failure})")
    if isinstance(failure, _TIMEOUTS):
        return RequestTimeout(f"the server at {url} did not answer in time")
    return ServerUnreachable(f"the connection to {url} was lost ({failure})")
