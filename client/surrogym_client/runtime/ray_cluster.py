"""Connect a command to a Ray cluster."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

from surrogym_shared.ray_address import no_cluster, require_cluster, send_token


class NoCluster(Exception):
    """The Ray cluster can't be used. ``str(error)`` is one sentence for a person."""


def connect(address: str, runtime_env: Mapping[str, Any] | None = None) -> None:
    """Connect this process to a Ray cluster.

    Args:
        address: ``auto`` for the cluster that this machine belongs to, or ``host:port``.
        runtime_env: Ray's runtime environment, which it prepares on each machine before it runs code of this process.

    Raises:
        NoCluster: Ray is not installed, there is no cluster at the address, the cluster has another version of Ray, or
            Ray refuses ``runtime_env``.
    """
    if find_spec("ray") is None:
        raise NoCluster("--on-ray: expected the package ray, got none: pip install 'surrogym[ray]'")
    send_token()
    import ray

    try:
        require_cluster(address)
    except ValueError as error:
        raise NoCluster(f"--on-ray: {error}") from error
    try:
        quiet: dict[str, Any] = {"log_to_driver": False, "configure_logging": False}
        ray.init(address, ignore_reinit_error=True, runtime_env=dict(runtime_env or {}), **quiet)
    except ConnectionError as error:
        said = "" if address == "auto" else " ".join(str(error).split())
        raise NoCluster(f"--on-ray: {no_cluster(address, said)}") from error
    except (ValueError, TypeError, RuntimeError) as error:
        raise NoCluster(
            f"--on-ray: the cluster at {address!r} can't be used: {' '.join(str(error).split())}"
        ) from error
