"""The environments of ``gymnasium.make`` and ``gymnasium.make_vec``: they reach their surrogate by HTTP.

Prefer SURROGYM_TOKEN to the argument ``token``: Gymnasium keeps arguments in the environment's spec, and
prints them.
"""

from __future__ import annotations

from typing import Any

from surrogym_client.env import RemoteEnv
from surrogym_client.transport import HttpSurrogate, Transport
from surrogym_client.vector import RemoteVectorEnv


def make_env(
    *, surrogate: str, url: str | None = None, token: str | None = None, transport: Transport = "auto", **options: Any
) -> RemoteEnv:
    """One lane of a surrogate; options are those of ``RemoteEnv``."""
    return RemoteEnv(HttpSurrogate(url, surrogate, token, transport=transport), **options)


def make_vector_env(
    *,
    num_envs: int,
    surrogate: str,
    url: str | None = None,
    token: str | None = None,
    transport: Transport = "auto",
    **options: Any,
) -> RemoteVectorEnv:
    """Many lanes of a surrogate; options are those of ``RemoteVectorEnv``."""
    return RemoteVectorEnv(HttpSurrogate(url, surrogate, token, transport=transport), num_envs, **options)
