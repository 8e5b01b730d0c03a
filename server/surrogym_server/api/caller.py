"""Who sends a request, as far as the server can tell."""

from __future__ import annotations

from starlette.types import Scope

from surrogym_server.api.auth import Gate, bearer_token
from surrogym_shared.wire import Role


def role_of(scope: Scope) -> Role:
    """The role of a request's token; admin where the server has no tokens.

    Raises:
        Unauthenticated: an unknown token, or none.
    """
    gate: Gate = scope["app"].state.gate
    return "admin" if gate.open else gate.role_of(bearer_token(scope) or "")
