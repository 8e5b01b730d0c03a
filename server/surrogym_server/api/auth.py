"""Permissions: bearer tokens with roles, and the sender of a request. A server without tokens allows all requests."""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Mapping
from functools import lru_cache
from ipaddress import ip_address

from fastapi import Depends
from fastapi.security import HTTPBearer
from starlette.types import Scope

from surrogym_server.api.headers import raw_header
from surrogym_server.errors import Forbidden, Unauthenticated
from surrogym_shared.wire import Role

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

    The dependency only describes the route in OpenAPI; the module ``api.door`` enforces the roles.
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
