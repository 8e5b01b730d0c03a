"""A policy: its file, the card beside it, its networks, and its export. Importing this room needs no torch."""

from typing import Any

from surrogym_client.policies.card import PolicyCard, UnusablePolicy, read_card
from surrogym_client.policies.files import load_policy

__all__ = ["PolicyCard", "UnusablePolicy", "load_policy", "read_card"]

NETWORKS = ("PaperPolicy", "Standardise", "decaying")  # found here by the files that Stable-Baselines3 wrote before


def __getattr__(name: str) -> Any:
    if name not in NETWORKS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from surrogym_client.policies import networks

    return getattr(networks, name)
