"""How a Ray cluster is reached: its address, and the token that it asks for."""

from __future__ import annotations

import os
import socket
from pathlib import Path

KNOCKING_SECONDS = 10.0
AUTH_MODE, TOKEN, TOKEN_PATH = "RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"


def send_token() -> None:
    """Let Ray send this user's token, if there is one. To be called before Ray is imported.

    ``ray start`` asks for the token if there is one. But Ray 2.60 reads whether to send it when it is imported, and
    decides to send it later, in ``ray.init``. A cluster that asks for no token ignores it.
    """
    path = Path(os.environ.get(TOKEN_PATH) or Path.home() / ".ray" / "auth_token")
    if os.environ.get(TOKEN) or path.is_file():
        os.environ.setdefault(AUTH_MODE, "token")


def require_cluster(address: str) -> None:
    """Raise ``ValueError`` if nobody listens at an address: Ray would try for minutes, and then end this process.

    Args:
        address: ``auto`` for the cluster that this machine belongs to, which Ray looks up itself, or ``host:port``.
    """
    if address == "auto":
        return
    host, _, port = address.rpartition(":")
    if not (host and port.isascii() and port.isdigit()) or "/" in host:
        raise ValueError(f"expected auto or host:port, got {address!r}")
    try:
        socket.create_connection((host, int(port)), KNOCKING_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise ValueError(no_cluster(address, str(getattr(error, "strerror", None) or error))) from error


def no_cluster(address: str, reason: str = "") -> str:
    """Return the sentence for an address without a cluster, with what to do about it."""
    why = f" ({reason})" if reason else ""
    return f"expected a cluster at {address!r}, got none{why}; begin one with RAY_worker_niceness=0 ray start --head"
