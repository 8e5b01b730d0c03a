"""Virtual environments of a surrogate on a server, in a file, or from a design in this process."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium

import surrogym_client  # noqa: F401  registers the environments with Gymnasium
from surrogym.files import SUFFIX, existing
from surrogym_client.environments.env import RemoteEnv
from surrogym_client.environments.file_factories import open_file
from surrogym_client.environments.vector import RemoteVectorEnv
from surrogym_client.registration import ENVIRONMENT_ID, FILE_ID
from surrogym_shared.port import SurrogatePort

if TYPE_CHECKING:
    from surrogym_client.sb3 import SurrogateVecEnv


def make(surrogate: Any, **options: Any) -> gymnasium.Env[Any, Any]:
    """Make a virtual environment of Gymnasium with one lane.

    Args:
        surrogate: the name of a surrogate on a server; the path of a file that ``surrogym export`` wrote, ending in
            ``.surrogate``; a ``Design`` that has a model; or anything that is a ``SurrogatePort``.
        options: for a name, ``url`` and ``token`` of the server; for all, those of ``RemoteEnv``: ``variant``,
            ``penalty``, ``max_episode_steps``, ...

    Raises:
        TypeError: the surrogate is none of these, or an option is unknown.
        ImportError: a file or a design needs the extra ``server``.
        OSError: the file can't be read.
        SurrogymClientError: the server can't be reached, or refuses.

    Examples:
        >>> env = surrogym.make("pendulum", url="http://127.0.0.1:8000")
        >>> observation, info = env.reset(seed=0)
    """
    if isinstance(surrogate, str | Path):
        return gymnasium.make(**_registered(surrogate), **options)
    return RemoteEnv(_port(surrogate), **options)


def make_vec(surrogate: Any, num_envs: int = 1, **options: Any) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
    """Make a virtual vector environment of Gymnasium with ``num_envs`` lanes. Arguments and errors are those of
    ``make``.

    Examples:
        >>> envs = surrogym.make_vec("pendulum.surrogate", num_envs=8)
    """
    if isinstance(surrogate, str | Path):
        return gymnasium.make_vec(**_registered(surrogate), num_envs=num_envs, **options)
    return RemoteVectorEnv(_port(surrogate), num_envs, **options)


def make_sb3(surrogate: Any, num_envs: int = 16, **options: Any) -> SurrogateVecEnv:
    """Make a vector environment of Stable-Baselines3 with ``num_envs`` lanes. This needs the extra ``train``.

    Arguments and errors are those of ``make``, except that ``options`` are those of ``SurrogateVecEnv``.

    Examples:
        >>> PPO("MlpPolicy", surrogym.make_sb3(design)).learn(100_000)
    """
    from surrogym_client.sb3 import SurrogateVecEnv

    if not isinstance(surrogate, str | Path):
        return SurrogateVecEnv.from_port(_port(surrogate), num_envs, **options)
    if Path(surrogate).suffix == SUFFIX:
        return SurrogateVecEnv.from_port(open_file(existing(surrogate)), num_envs, **options)
    return SurrogateVecEnv(options.pop("url", None), str(surrogate), num_envs, **options)


def _registered(surrogate: str | Path) -> dict[str, Any]:
    if Path(surrogate).suffix == SUFFIX:
        return {"id": FILE_ID, "file": existing(surrogate)}
    return {"id": ENVIRONMENT_ID, "surrogate": str(surrogate)}


def _port(surrogate: Any) -> SurrogatePort:
    made = surrogate.surrogate() if hasattr(surrogate, "surrogate") else surrogate
    if not hasattr(made, "open"):
        raise TypeError(
            f"expected the name of a surrogate, a path ending in {SUFFIX}, a Design or a SurrogatePort, "
            f"got {type(surrogate).__name__}"
        )
    port: SurrogatePort = made
    return port
