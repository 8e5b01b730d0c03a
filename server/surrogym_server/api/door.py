"""What is checked and read of a request before its route: token, roles, media type, size, JSON body, and room to wait.

A route declares its roles among its dependencies, such as ``READ``, the media types of its body by its parameters, and
the size of a JSON body by ``json_up_to``. These conditions are checked from the headers, before the body is read. A
server without tokens allows all requests. JSON is parsed strictly.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
from collections import Counter
from collections.abc import Callable, Coroutine, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from ipaddress import ip_address
from typing import Any, TypeVar

import jiter
from fastapi import Body, Depends, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from fastapi.routing import APIRoute
from fastapi.security import HTTPBearer
from pydantic import BaseModel, ValidationError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import Scope

from surrogym_server.errors import Forbidden, Overloaded, Unauthenticated
from surrogym_shared import frames
from surrogym_shared.wire import Role


def raw_header(scope: Scope, name: bytes) -> bytes:
    """Return the first header of a request with this lower-case name; empty if there is none."""
    for key, value in scope["headers"]:
        if key == name:
            found: bytes = value
            return found
    return b""


SALT = b"surrogym"
WORK = 2**12  # cost parameter n of scrypt: an attempt to guess the token of a fingerprint takes 10 ms and 4 MB
FINGERPRINT_BYTES = 5
DESCRIPTION = "A token of this server; not needed on loopback without tokens."


class Gate:
    """The known tokens and their roles. Tokens are compared in constant time, against timing attacks."""

    def __init__(self, tokens: Mapping[str, Role]) -> None:
        self._tokens = [(token.encode(), role) for token, role in tokens.items()]

    @property
    def open(self) -> bool:
        return not self._tokens

    def role_of(self, token: str) -> Role:
        """Return the role of a token. Raises ``Unauthenticated`` if it is unknown."""
        found = [role for known, role in self._tokens if hmac.compare_digest(known, token.encode())]
        if not found:
            raise Unauthenticated(
                "expected a known bearer token, got an unknown one: set SURROGYM_TOKEN, or ask the server's admin"
            )
        return found[0]

    def check(self, token: str | None, allowed: tuple[Role, ...]) -> None:
        """Check that a token may call a route.

        Raises:
            Unauthenticated: the token is missing or unknown.
            Forbidden: the token's role is neither admin nor in ``allowed``.
        """
        if self.open:
            return
        if token is None:
            raise Unauthenticated("expected the header 'Authorization: Bearer <token>', got none: set SURROGYM_TOKEN")
        role = self.role_of(token)
        if role not in (*allowed, "admin"):
            raise Forbidden(
                f"expected a token with role {' or '.join((*allowed, 'admin'))}, got one with role {role}: "
                "use another token, or ask the server's admin"
            )


def bearer_token(scope: Scope) -> str | None:
    """Return the bearer token in the headers of a request; None if there is none."""
    scheme, _, token = raw_header(scope, b"authorization").decode("latin-1").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else None


class Access(HTTPBearer):
    """Dependency that declares which roles may call a route, in addition to admin.

    The dependency only describes the route in OpenAPI; ``Door`` enforces the roles.
    """

    def __init__(self, *roles: Role) -> None:
        super().__init__(scheme_name="HTTPBearer", description=DESCRIPTION, auto_error=False)
        self.roles = roles


def everybody() -> None:
    """Dependency that declares that a route needs no token."""


PUBLIC = Depends(everybody)
READ = Depends(Access("read", "train", "sample"))
TRAIN = Depends(Access("train"))
SAMPLE = Depends(Access("sample"))
TRAIN_OR_SAMPLE = Depends(Access("train", "sample"))
ADMIN = Depends(Access())


def role_of(scope: Scope) -> Role:
    """Return the role of a request's token; admin if the server has no tokens.

    Raises:
        Unauthenticated: the token is missing or unknown.
    """
    gate: Gate = scope["app"].state.gate
    return "admin" if gate.open else gate.role_of(bearer_token(scope) or "")


def caller(scope: Scope) -> str:
    """Describe the sender of a request for the log: role and fingerprint of its token, and its address.

    An unknown token has no fingerprint in the log, because it may be a password that was entered by mistake.
    """
    return f"{holder(scope)} from {_address(scope)}"


@lru_cache(maxsize=1_024)
def fingerprint(token: str) -> str:
    """Return ten characters that identify a token without revealing it; the same on every server."""
    return hashlib.scrypt(token.encode(), salt=SALT, n=WORK, r=8, p=1, dklen=FINGERPRINT_BYTES).hex()


def holder(scope: Scope) -> str:
    """Return the role and fingerprint of a request's token as text.

    Without them: ``anybody`` if the server has no tokens, ``nobody`` if the request has none, or "an unknown token".
    """
    gate: Gate = scope["app"].state.gate
    if gate.open:
        return "anybody"
    token = bearer_token(scope)
    if token is None:
        return "nobody"
    try:
        return f"{gate.role_of(token)} {fingerprint(token)}"
    except Unauthenticated:
        return "an unknown token"


def _address(scope: Scope) -> str:
    """Return the address of a request's sender; behind a proxy on this machine, the address that the proxy forwards."""
    host, _ = scope.get("client") or ("", 0)
    try:
        return str(ip_address(host))
    except ValueError:
        return "an unknown address"


M = TypeVar("M", bound=BaseModel)

JSON = "application/json"
LONG = 16 * 1024  # parsing a longer body, in bytes, takes over 0.5 ms; other requests may run before it
DEEPEST = 200  # largest number of nested levels that the parser jiter accepts
MOST_FIELDS = 64  # largest number of top-level fields of a body, because the error names each unknown one
SCHEMAS = "#/components/schemas/{model}"
BINARY: dict[str, Any] = {frames.MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}}


class JsonRequest(Request):
    """A request whose JSON body is parsed by this module instead of by FastAPI."""

    async def json(self) -> Any:
        """Parse the body as JSON. Raises ``HTTPException`` 400 if that fails."""
        content = await self.body()
        await take_turn(self.scope, content)
        return parse(content)


async def take_turn(scope: Scope, content: bytes) -> None:
    """Before a long body is parsed, let the event loop serve other requests.

    At most one long body is parsed in an iteration of the event loop. A thread would not help, because the parser holds
    the global interpreter lock.
    """
    if len(content) > LONG:
        turn: asyncio.Lock = scope["app"].state.parsing
        async with turn:
            await asyncio.sleep(0)


def parse(content: bytes) -> Any:
    """Parse a JSON text.

    Raises:
        HTTPException: 400 if the text is not JSON in UTF-8, an object has a key twice, or there are too many nested
            levels or fields.
    """
    try:
        parsed = jiter.from_json(content, catch_duplicate_keys=True)
    except ValueError as error:
        raise HTTPException(
            400,
            f"the body: expected JSON in UTF-8 with each key once and at most {DEEPEST} levels; parsing stopped: "
            f"{error}",
        ) from None
    if isinstance(parsed, dict) and len(parsed) > MOST_FIELDS:
        raise HTTPException(400, f"the body: expected at most {MOST_FIELDS} fields, got {len(parsed)}")
    return parsed


def parse_as(model: type[M], content: bytes) -> M:
    """Parse the JSON body of a request, and validate it as an instance of ``model``.

    Raises:
        HTTPException: 400 if the body is not valid JSON.
        RequestValidationError: the body is not a valid instance of ``model``.
    """
    try:
        return model.model_validate(parse(content))
    except ValidationError as error:
        raise RequestValidationError(error.errors(include_url=False)) from error


def described(model: type[BaseModel], example: dict[str, Any]) -> dict[str, Any]:
    """Return the OpenAPI description of a body that may be JSON or a binary frame."""
    schema = model.model_json_schema(ref_template=SCHEMAS)
    content = {JSON: {"schema": schema, "example": example}, **BINARY}
    return {"requestBody": {"required": True, "content": content}}


def example(value: dict[str, Any]) -> Any:
    """Return FastAPI's declaration of a request body, with an example for the documentation."""
    return Body(openapi_examples={"example": {"value": value}})


T = TypeVar("T")

MAX_WAITING = 2_000  # largest number of waiting requests of one kind with one token: an eighth of all connections


class ConcurrencyLimit:
    """Limit on the requests of one kind: at most ``at_work`` of them run at a time, each in a thread, and at most
    ``waiting`` more wait."""

    def __init__(self, what: str, at_work: int, waiting: int) -> None:
        """Set the limits. ``what`` names the requests in error messages, such as "predictions"."""
        self._what = what
        self._most = at_work + waiting
        self._inside = 0
        self._turn = asyncio.Semaphore(at_work)

    async def take(self, request: Request, work: Callable[[], T]) -> T:
        """Run ``work`` in a thread as soon as fewer than ``at_work`` requests run, and return its result.

        Raises:
            Overloaded: too many requests wait.
            ClientDisconnect: the caller has disconnected during the wait; ``work`` was not run.
        """
        if self._inside >= self._most:
            raise Overloaded(
                f"expected at most {self._most} {self._what} at work or waiting, got one more: try again later"
            )
        self._inside += 1
        try:
            async with self._turn:
                await require_present(request)
                return await asyncio.to_thread(work)
        finally:
            self._inside -= 1


class Waiting:
    """Limit on the number of requests of each token that wait for something to happen. Each waiting request takes
    memory."""

    def __init__(self, what: str, most: int = MAX_WAITING) -> None:
        """Set the limit ``most``. ``what`` names the requests in error messages, such as "open streams of events"."""
        self._what = what
        self._most = most
        self._by_token = Counter[str | None]()

    def require_room(self, request: Request) -> None:
        """Raise ``Overloaded`` if the token of a request has the largest allowed number of waiting requests."""
        if self._by_token[bearer_token(request.scope)] >= self._most:
            raise Overloaded(f"expected at most {self._most} {self._what} with one token, got one more: close some")

    @contextmanager
    def count(self, request: Request) -> Iterator[None]:
        """Return a context during which a request counts as waiting."""
        token = bearer_token(request.scope)
        self._by_token[token] += 1
        try:
            yield
        finally:
            self._by_token[token] -= 1


async def require_present(request: Request) -> None:
    """Raise ``ClientDisconnect`` if the caller has closed its connection."""
    if await request.is_disconnected():
        raise ClientDisconnect


MEDIA_TYPE = "surrogym.media_type"  # key in the ASGI scope: media type of the body, if the route reads one
BODY_LIMIT = "surrogym.body_limit"  # key in the ASGI scope: largest size of this body in bytes, set by ``Door``
JSON_LIMIT = "x-max-json-bytes"  # key in a route's OpenAPI description: largest JSON body in bytes
KIBIBYTE = 1024
DEFAULT_JSON_BYTES = 64 * KIBIBYTE


def json_up_to(kibibytes: int) -> dict[str, Any]:
    """Return ``openapi_extra`` for a route whose JSON bodies may have up to ``kibibytes`` KiB. The default is 64
    KiB."""
    return {JSON_LIMIT: kibibytes * KIBIBYTE}


@dataclass(frozen=True)
class Door:
    """Conditions for a request to a route, checked before the body is read.

    Attributes:
        roles: roles that may call the route, in addition to admin; None if the route needs no token.
        bodies: accepted media types of the body, each with its largest size in bytes (None: the server's general
            limit); empty if the route reads no body.
    """

    roles: tuple[Role, ...] | None
    bodies: Mapping[str, int | None]

    def admit(self, scope: Scope) -> None:
        """Check the headers of a request, and put the media type and the size limit of its body into its ASGI scope.

        Raises:
            Unauthenticated: the token is missing or unknown.
            Forbidden: the token's role does not allow this route.
            HTTPException: 415 if the media type is wrong or the body has a content encoding such as gzip, 413 if
                Content-Length is too large.
        """
        state = scope["app"].state
        gate: Gate = state.gate
        if self.roles is not None:
            gate.check(bearer_token(scope), self.roles)
        if not self.bodies:
            return
        scope[MEDIA_TYPE] = media_type = self._media_type(scope)
        own, most = self.bodies[media_type], state.max_body_bytes
        scope[BODY_LIMIT] = limit = most if own is None else min(own, most)
        announced = raw_header(scope, b"content-length")
        if announced.isdigit() and int(announced) > limit:
            larger = [name for name, size in self.bodies.items() if size is None and name != media_type]
            instead = f"; send a larger body as {larger[0]}" if larger else ": send less at a time"
            raise HTTPException(
                413,
                f"expected a body of at most {limit} bytes as {media_type}, got {announced.decode()} bytes{instead}",
            )

    def _media_type(self, scope: Scope) -> str:
        given = raw_header(scope, b"content-type").decode("latin-1").partition(";")[0].strip().lower()
        if given not in self.bodies:
            raise HTTPException(415, f"expected content type {' or '.join(self.bodies)}, got {given or 'none'}")
        encoding = raw_header(scope, b"content-encoding").decode("latin-1").strip().lower()
        if encoding not in ("", "identity"):
            raise HTTPException(415, f"expected a body without content encoding, got {encoding!r}: don't compress it")
        return given


def door_of(route: APIRoute) -> Door:
    """Return the conditions that a route declares. Raises ``TypeError`` if the route does not declare its roles."""
    declared = [depends.dependency for depends in route.dependencies]
    access = [one for one in declared if isinstance(one, Access)]
    if (count := len(access) + (everybody in declared)) != 1:
        raise TypeError(
            f"route {route.path}: expected one declaration of who may call it, such as READ, got {count}: declare one"
        )
    extra = route.openapi_extra or {}
    content = extra.get("requestBody", {}).get("content", {JSON: {}} if route.body_field else {})
    limits: dict[str, int | None] = dict.fromkeys(content)
    if JSON in limits:
        limits[JSON] = extra.get(JSON_LIMIT, DEFAULT_JSON_BYTES)
    return Door(access[0].roles if access else None, limits)


class DoorRoute(APIRoute):
    """A FastAPI route that checks roles, media type and size of a request before it reads the body."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        door, handle = door_of(self), super().get_route_handler()

        async def admitted(request: Request) -> Response:
            door.admit(request.scope)
            return await handle(JsonRequest(request.scope, request.receive))

        return admitted
