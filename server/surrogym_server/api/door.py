"""Conditions for a request to a route, checked from its headers before the body is read: roles, media type, size.

A route declares its roles among its dependencies (``api.auth``), the media types of its body by its parameters, and
the size of a JSON body by ``json_up_to``.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass
from typing import Any

from fastapi import Request
from fastapi.responses import Response
from fastapi.routing import APIRoute
from starlette.exceptions import HTTPException
from starlette.types import Scope

from surrogym_server.api.auth import Access, Gate, bearer_token, everybody
from surrogym_server.api.guards import BODY_LIMIT
from surrogym_server.api.headers import raw_header
from surrogym_server.api.json_body import JSON, JsonRequest
from surrogym_shared.wire import Role

MEDIA_TYPE = "surrogym.media_type"  # key in the ASGI scope: media type of the body, if the route reads one
JSON_LIMIT = "x-max-json-bytes"  # key in a route's OpenAPI description: largest JSON body in bytes
KIBIBYTE = 1024
DEFAULT_JSON_BYTES = 64 * KIBIBYTE


def json_up_to(kibibytes: int) -> dict[str, Any]:
    """Return ``openapi_extra`` for a route whose JSON bodies may be larger than the default of 64 KiB."""
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
            instead = f"; send a larger body as {larger[0]}" if larger else ""
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
        raise TypeError(f"route {route.path}: expected one declaration of who may call it, such as READ, got {count}")
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
