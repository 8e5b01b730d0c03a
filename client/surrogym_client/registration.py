"""What makes ``gymnasium.make("surrogym/Remote-v0", url=..., surrogate=...)`` work."""

from __future__ import annotations

import gymnasium

ENVIRONMENT_ID = "surrogym/Remote-v0"


def register() -> None:
    """Enter the remote environment into Gymnasium's registry; doing it twice is harmless."""
    if ENVIRONMENT_ID not in gymnasium.registry:
        gymnasium.register(
            ENVIRONMENT_ID,
            entry_point="surrogym_client.remote:make_env",
            vector_entry_point="surrogym_client.remote:make_vector_env",
        )
