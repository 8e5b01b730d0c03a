"""A surrogate's file as an environment: stepped in this process, without a server."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from surrogym_client.environments.env import RemoteEnv
from surrogym_client.environments.vector import RemoteVectorEnv
from surrogym_shared.port import SurrogatePort

ENTRY_POINTS = "surrogym.ports"  # what steps a surrogate in this process, brought by the server's package


def open_file(path: str | Path) -> SurrogatePort:
    """A surrogate stepped in this process, without a server; the same seeds give the same steps, bit for bit.

    Raises:
        ImportError: this needs the extra ``server``.
        OSError: the file can't be read.
        ValueError: it is no surrogate's file, or its model none of its specification.

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
    """One lane of a surrogate's file, for ``gymnasium.make("surrogym/File-v0", file=...)``; raises as ``open_file``."""
    return RemoteEnv(open_file(file), **options)


def make_vector_env(*, num_envs: int, file: str | Path, **options: Any) -> RemoteVectorEnv:
    """Many lanes, for ``gymnasium.make_vec``; raises as ``open_file``."""
    return RemoteVectorEnv(open_file(file), num_envs, **options)
