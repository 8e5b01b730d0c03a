"""Policies: their files, the cards beside them, their networks, and their export. Importing this package needs no
torch."""

from typing import Any

from surrogym_client.policies.card import PolicyCard, UnusablePolicy, read_card
from surrogym_client.policies.files import load_policy

__all__ = ["PolicyCard", "UnusablePolicy", "load_policy", "read_card"]

NETWORKS = ("PaperPolicy", "Standardise", "decaying")  # older files of Stable-Baselines3 refer to these names here


def __getattr__(name: str) -> Any:
    if name not in NETWORKS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from surrogym_client.policies import networks

    return getattr(networks, name)
