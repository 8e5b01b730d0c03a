"""The pool of session hosts in a Ray cluster. The first server starts it, and further servers find it.

Ray is imported when it is used: a server without a cluster needs no Ray.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import fields
from importlib.util import find_spec
from typing import Any

import sqlalchemy as sa

from surrogym_server.engine.design_job import DesignJob, DesignResult
from surrogym_server.engine.port import Compute, SessionEngine
from surrogym_server.errors import InvalidInput, Unavailable
from surrogym_server.feature import Cluster
from surrogym_server.features.ray.host import HostInfo, HostSettings, SessionHost, versions
from surrogym_server.features.ray.store import LiveSessions
from surrogym_server.settings import Settings
from surrogym_server.storage.sql import Storage
from surrogym_shared.ray_address import no_cluster, require_cluster, send_token

logger = logging.getLogger(__name__)

NAMESPACE = "surrogym"
STARTING_SECONDS = 180.0
QUIET_SECONDS = 10.0  # time after which the log mentions hosts that have not started


def check(settings: Settings) -> None:
    """Raise ``InvalidInput`` if this server can't use a cluster: Ray is not installed, or the database is SQLite."""
    if find_spec("ray") is None:
        raise InvalidInput("engine ray: the package ray is not installed: pip install 'surrogym[ray]'")
    if settings.database_url.startswith("sqlite"):
        raise InvalidInput(
            "engine ray: expected a PostgreSQL database, which all machines reach, got a SQLite file: give "
            "--database postgresql+psycopg://user@host/name"
        )


def connect(settings: Settings, storage: Storage) -> SessionEngine:
    """Connect to the cluster at ``ray_address``, wait until all session hosts are ready, and return an engine that uses
    them.

    Args:
        settings: settings of this server.
        storage: storage of this server, where the sessions are recorded.

    Raises:
        InvalidInput: this server can't use a cluster, there is none, or it runs with other versions or settings.
        Unavailable: the session hosts don't become ready.
    """
    check(settings)
    send_token()
    import ray

    try:
        require_cluster(settings.ray_address)
    except ValueError as error:
        raise InvalidInput(f"engine ray: {error}") from error
    quiet: dict[str, Any] = {"log_to_driver": False, "configure_logging": False}
    try:
        ray.init(settings.ray_address, namespace=NAMESPACE, ignore_reinit_error=True, **quiet)
    except ConnectionError as error:
        raise InvalidInput(f"engine ray: {no_cluster(settings.ray_address)}") from error
    except RuntimeError as error:  # for example, the versions of Ray or Python differ
        said = " ".join(str(error).split())
        if "ersion mismatch" in said:
            raise InvalidInput(
                f"engine ray: expected a cluster with this server's versions of Ray and Python: {said}"
            ) from error
        raise Unavailable(f"engine ray: the cluster can't be used: {said}") from error
    return _of_hosts(HostSettings.of(settings), storage.part(LiveSessions))


def fits_of(settings: Settings, function: Callable[[DesignJob], DesignResult]) -> Compute | None:
    """Return the object that computes fits in the connected cluster; None if the session hosts leave no CPU or too few
    GPUs for fits."""
    import ray

    from surrogym_server.features.ray.fits import RayFits

    untyped: Any = ray
    resources: dict[str, float] = untyped.cluster_resources()
    cpus, gpus = resources.get("CPU", 0.0), resources.get("GPU", 0.0)
    if cpus <= settings.ray_hosts:
        logger.warning(
            "fits run on this machine: the cluster has %g CPUs, and each of its %d session hosts takes one",
            cpus,
            settings.ray_hosts,
        )
        return None
    taken = settings.ray_hosts * _gpus_of_host(settings.device)
    if settings.ray_fit_gpus > 0 and gpus < taken + settings.ray_fit_gpus:
        logger.warning(
            "fits run on this machine: the cluster has %g GPUs, its session hosts take %d, and a fit asks for %g",
            *(gpus, taken, settings.ray_fit_gpus),
        )
        return None
    logger.info("fits run as tasks of the cluster")
    return RayFits(function, settings.ray_fit_gpus)


def _gpus_of_host(device: str) -> int:
    return 1 if device == "cuda" else 0


def _of_hosts(wanted: HostSettings, store: LiveSessions) -> SessionEngine:
    from surrogym_server.features.ray.engine import RayEngine

    pool = pool_name(wanted.database)
    first = _host(pool, 0, wanted)
    about_first = _about([first], wanted)
    _require_same(wanted, about_first)  # checked before further hosts are started
    settings = about_first[0].settings
    hosts = [first, *(_host(pool, number, settings) for number in range(1, settings.hosts))]
    found = _about(hosts, wanted)
    _require_same(wanted, found)
    for number, host in enumerate(found):
        logger.info("session host %d: process %d on %s", number, host.pid, host.node)
    machines = [host.machine for host in found]
    return RayEngine(hosts, machines, store, settings)


def _about(hosts: Sequence[Any], wanted: HostSettings) -> list[HostInfo]:
    import ray

    asked = [host.about.remote() for host in hosts]
    quiet = min(QUIET_SECONDS, STARTING_SECONDS)
    _, waiting = ray.wait(asked, num_returns=len(asked), timeout=quiet)
    if waiting:
        _tell_waiting(len(waiting), wanted.device)
    try:
        found: list[HostInfo] = ray.get(asked, timeout=STARTING_SECONDS - quiet)
    except ray.exceptions.GetTimeoutError as error:
        raise Unavailable(
            f"engine ray: expected {wanted.hosts} session hosts to start within {STARTING_SECONDS:g} s, but fewer did: "
            f"each takes {_taken_by_host(wanted.device)}, so add machines or choose fewer --ray-hosts"
        ) from error
    except ray.exceptions.RayError as error:
        last = str(error).strip().splitlines()[-1]
        raise Unavailable(f"engine ray: a session host can't start: {last.strip()}") from error
    return found


def _taken_by_host(device: str) -> str:
    return f"one of the cluster's CPUs{' and one of its GPUs' if _gpus_of_host(device) else ''}"


def _tell_waiting(count: int, device: str) -> None:
    import ray

    untyped: Any = ray
    free: dict[str, float] = untyped.available_resources()
    total: dict[str, float] = untyped.cluster_resources()
    names = ("CPU", "GPU") if _gpus_of_host(device) else ("CPU",)
    logger.warning(
        "waiting for %d session hosts to start, for %g s at most: each takes %s, and free are %s; another --database, "
        "or another way to write its address, has session hosts of its own",
        count,
        STARTING_SECONDS,
        _taken_by_host(device),
        " and ".join(f"{free.get(name, 0.0):g} of {total.get(name, 0.0):g} {name}s" for name in names),
    )


def pool_name(database: str) -> str:
    """Return the name of the pool for a database, from its address without user and password."""
    url = sa.make_url(database)
    return f"{url.host or url.query.get('host', '')}:{url.port or ''}/{url.database}"


def _host(pool: str, number: int, settings: HostSettings) -> Any:
    import ray

    options: dict[str, Any] = {
        "name": f"session host {number} of {pool}",
        "lifetime": "detached",  # a host outlives the server that started it
        "get_if_exists": True,
        "max_restarts": -1,
        "num_cpus": 1,
        "num_gpus": _gpus_of_host(settings.device),
        "max_concurrency": max(settings.limits.requests, 100) + 100,
    }
    return ray.remote(SessionHost).options(**options).remote(settings, number)


def _require_same(wanted: HostSettings, found: Sequence[HostInfo]) -> None:
    mine = versions()
    for host in found:
        for name, theirs in host.versions.items():
            if theirs != mine.get(name):
                raise InvalidInput(
                    f"engine ray: expected {name} {theirs}, which the session hosts run, got {name} {mine.get(name)}: "
                    "install the same version here"
                )
        for field in (field for field in fields(HostSettings) if field.compare):
            theirs, ours = getattr(host.settings, field.name), getattr(wanted, field.name)
            if theirs != ours:
                told = f"{theirs}, got {ours}" if field.repr else "another one"
                raise InvalidInput(
                    f"engine ray: expected the settings of the running session hosts, which have {field.name} {told}: "
                    "use the same, or end the hosts with ray stop"
                )


CLUSTER = Cluster(check, connect, fits_of)
