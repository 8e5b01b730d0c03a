"""Environments of ``gymnasium.make`` and ``gymnasium.make_vec`` that reach their surrogate over HTTP.

Prefer SURROGYM_TOKEN to the argument ``token``: Gymnasium keeps arguments in the environment's spec, and prints them.
"""

from __future__ import annotations

from typing import Any

from surrogym_client.environments.env import RemoteEnv
from surrogym_client.environments.vector import RemoteVectorEnv
from surrogym_client.registration import ENVIRONMENT_ID
from surrogym_client.transport.http_surrogate import HttpSurrogate, Transport


def make_env(
    *,
    surrogate: str | None = None,
    url: str | None = None,
    token: str | None = None,
    transport: Transport = "auto",
    **options: Any,
) -> RemoteEnv:
    """Make an environment of a surrogate on a server. ``options`` are those of ``RemoteEnv``.

    Raises:
        ValueError: no surrogate was given.
    """
    return RemoteEnv(HttpSurrogate(url, _named(surrogate), token, transport=transport), **options)


def make_vector_env(
    *,
    num_envs: int,
    surrogate: str | None = None,
    url: str | None = None,
    token: str | None = None,
    transport: Transport = "auto",
    **options: Any,
) -> RemoteVectorEnv:
    """Make a vector environment of a surrogate on a server. ``options`` are those of ``RemoteVectorEnv``.

    Raises:
        ValueError: no surrogate was given.
    """
    return RemoteVectorEnv(HttpSurrogate(url, _named(surrogate), token, transport=transport), num_envs, **options)


def _named(surrogate: str | None) -> str:
    if surrogate is None:
        raise ValueError(
            f'expected the name of a surrogate: gymnasium.make("{ENVIRONMENT_ID}", surrogate="its name"); '
            "surrogym status lists a server's surrogates"
        )
    return surrogate
