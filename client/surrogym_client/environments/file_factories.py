"""Environments from a surrogate's file, stepped in this process without a server."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from surrogym_client.environments.env import RemoteEnv
from surrogym_client.environments.vector import RemoteVectorEnv
from surrogym_shared.port import SurrogatePort

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


def make_env(*, file: str | Path, **options: Any) -> RemoteEnv:
    """Make an environment from a surrogate's file, for ``gymnasium.make("surrogym/File-v0", file=...)``. Raises the
    errors of ``open_file``."""
    return RemoteEnv(open_file(file), **options)


def make_vector_env(*, num_envs: int, file: str | Path, **options: Any) -> RemoteVectorEnv:
    """Make a vector environment from a file, for ``gymnasium.make_vec``. Raises the errors of ``open_file``."""
    return RemoteVectorEnv(open_file(file), num_envs, **options)
