"""Address of a Ray cluster."""

from __future__ import annotations

import socket

KNOCKING_SECONDS = 10.0


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
        raise ValueError(f"expected a cluster at {address!r}, got none: {error}") from error
