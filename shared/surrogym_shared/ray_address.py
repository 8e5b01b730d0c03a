"""Reach a Ray cluster: check its address, and send the token that it requires."""

from __future__ import annotations

import os
import socket
from pathlib import Path

KNOCKING_SECONDS = 10.0
AUTH_MODE, TOKEN, TOKEN_PATH = "RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"


def send_token() -> None:
    """Set the environment so that Ray sends this user's token, if there is one. Call this before Ray is imported.

    A cluster that was started by ``ray start`` requires the user's token if there is one. Ray 2.60 decides when it is
    imported whether it sends the token. A cluster that requires no token ignores it.
    """
    path = Path(os.environ.get(TOKEN_PATH) or Path.home() / ".ray" / "auth_token")
    if os.environ.get(TOKEN) or path.is_file():
        os.environ.setdefault(AUTH_MODE, "token")


def require_cluster(address: str) -> None:
    """Raise ``ValueError`` if no process listens at an address: Ray would try for minutes, and then end this process.

    Args:
        address: ``auto`` for the cluster that this machine belongs to, which Ray looks up itself, or ``host:port``.
    """
    if address == "auto":
        return
    host, _, port = address.rpartition(":")
    if not (host and port.isascii() and port.isdigit()) or "/" in host:
        raise ValueError(f"expected the address of a Ray cluster, auto or host:port, got {address!r}")
    try:
        socket.create_connection((host, int(port)), KNOCKING_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise ValueError(no_cluster(address, str(getattr(error, "strerror", None) or error))) from error


def no_cluster(address: str, reason: str = "") -> str:
    """Return the error message for an address without a Ray cluster, with the command that starts one."""
    why = f" ({reason})" if reason else ""
    return (
        f"expected a Ray cluster at {address!r}, got none{why}; start one with RAY_worker_niceness=0 ray start --head"
    )
