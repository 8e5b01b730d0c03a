"""Environments from a surrogate's file, stepped in this process without a server."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from surrogym_client.environments.env import RemoteEnv
from surrogym_client.environments.vector import RemoteVectorEnv
from surrogym_shared.port import Planning, PlanningPort, SurrogatePort

# Group of entry points in which the server's package registers a function that opens a surrogate's file in this
# process.
ENTRY_POINTS = "surrogym.ports"


def open_file(path: str | Path) -> SurrogatePort:
    """Open a surrogate's file, to step it in this process without a server. The same seeds give the same steps, bit
    for bit.

    Raises:
        ImportError: the extra ``server`` is missing.
        OSError: the file can't be read.
        ValueError: the file is not an exported surrogate, or its model does not fit its specification.

    Examples:
        >>> env = SurrogateVecEnv.from_port(open_file("pendulum.surrogate"), num_envs=16)
    """
    (entry,) = entry_points(group=ENTRY_POINTS, name="file")
    try:
        opened: SurrogatePort = entry.load()(path)
    except ModuleNotFoundError as error:
        raise ImportError(f"stepping a file needs {error.name}: pip install 'surrogym[server]'") from error
    return opened


def planner_of(
    file: bytes,
    horizon: int,
    seed: int,
    set_points: Mapping[str, float],
    limits: Sequence[str] = (),
    sensor_noise: Mapping[str, float] | None = None,
) -> Planning:
    """Return a function that plans actions in this process, on the model in the content of a surrogate's ``file``. This
    computes its values, in some seconds. ``PlanningPort.planner`` explains the other arguments.

    Raises:
        ImportError: the extra ``server`` is missing.
        TypeError: the installed server can't plan.
        ValueError: the model does not fit its specification, or does not allow planning; with the reason.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / "model.surrogate"
        path.write_bytes(file)
        port = open_file(path)
    if not isinstance(port, PlanningPort):
        raise TypeError("the installed server can't plan")
    return port.planner(horizon, seed, set_points, limits, sensor_noise)


def make_env(*, file: str | Path, **options: Any) -> RemoteEnv:
    """Make an environment from a surrogate's file, for ``gymnasium.make("surrogym/File-v0", file=...)``. Raises the
    errors of ``open_file``."""
    return RemoteEnv(open_file(file), **options)


def make_vector_env(*, num_envs: int, file: str | Path, **options: Any) -> RemoteVectorEnv:
    """Make a vector environment from a file, for ``gymnasium.make_vec``. Raises the errors of ``open_file``."""
    return RemoteVectorEnv(open_file(file), num_envs, **options)
