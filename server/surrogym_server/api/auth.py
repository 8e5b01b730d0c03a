"""Who may do what: bearer tokens with roles. Without any token configured, everybody may do everything."""

from __future__ import annotations

import hmac
from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.datastructures import Headers

from surrogym_server.errors import Forbidden, Unauthenticated
from surrogym_shared.wire import Role

bearer = HTTPBearer(auto_error=False, description="A token of this server; not needed on loopback without tokens.")


class Gate:
    """Role of each known token. Tokens are compared in constant time."""

    def __init__(self, tokens: Mapping[str, Role]) -> None:
        self._tokens = [(token.encode(), role) for token, role in tokens.items()]

    @property
    def open(self) -> bool:
        return not self._tokens

    def role_of(self, token: str) -> Role:
        """Raises ``Unauthenticated`` for an unknown token."""
        found = [role for known, role in self._tokens if hmac.compare_digest(known, token.encode())]
        if not found:
            raise Unauthenticated("expected a known bearer token, got an unknown one")
        return found[0]

    def check(self, token: str | None, allowed: tuple[Role, ...]) -> None:
        """Let pass who may.

        Raises:
            Unauthenticated: no token, or an unknown one.
            Forbidden: the token's role is none of ``allowed``.
        """
        if self.open:
            return
        if token is None:
            raise Unauthenticated("expected the header 'Authorization: Bearer <token>', got none")
        role = self.role_of(token)
        if role not in (*allowed, "admin"):
            raise Forbidden(f"expected a token with role {' or '.join((*allowed, 'admin'))}, got {role}")


def bearer_token(headers: Headers) -> str | None:
    """The token of a request, for routes that read theirs themselves."""
    scheme, _, token = headers.get("authorization", "").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else None


def allow(*roles: Role) -> Any:
    """Dependency of a route: tokens of these roles, and admin, may call it."""

    async def check(
        request: Request, credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)]
    ) -> None:
        gate: Gate = request.app.state.gate
        gate.check(None if credentials is None else credentials.credentials, roles)

    return Depends(check)


READ = allow("read", "train", "sample")
TRAIN = allow("train")
SAMPLE = allow("sample")
TRAIN_OR_SAMPLE = allow("train", "sample")
ADMIN = allow()
