"""Description of a request's sender for the log, without any token."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from ipaddress import ip_address

from starlette.types import Scope

from surrogym_server.api.auth import Gate, bearer_token
from surrogym_server.errors import Unauthenticated
from surrogym_shared.wire import Role

SALT = b"surrogym"
WORK = 2**12  # of scrypt: 10 ms and 4 MB for each attempt to guess the token behind a fingerprint
FINGERPRINT_BYTES = 5


def role_of(scope: Scope) -> Role:
    """The role of a request's token; admin if the server has no tokens.

    Raises:
        Unauthenticated: an unknown token, or none.
    """
    gate: Gate = scope["app"].state.gate
    return "admin" if gate.open else gate.role_of(bearer_token(scope) or "")


def caller(scope: Scope) -> str:
    """Role and fingerprint of a request's token, and the address of its sender. Only known tokens have a fingerprint,
    because a mistyped one may be the password of something else."""
    return f"{holder(scope)} from {_address(scope)}"


@lru_cache(maxsize=1_024)
def fingerprint(token: str) -> str:
    """Ten characters that distinguish tokens, the same on every server and after every start."""
    return hashlib.scrypt(token.encode(), salt=SALT, n=WORK, r=8, p=1, dklen=FINGERPRINT_BYTES).hex()


def holder(scope: Scope) -> str:
    """Role and fingerprint of a request's token; ``anybody`` if the server has no tokens."""
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
    """Address of the connection. If that is a proxy on this machine, the address that it forwards."""
    host, _ = scope.get("client") or ("", 0)
    try:
        return str(ip_address(host))
    except ValueError:
        return "an unknown address"
