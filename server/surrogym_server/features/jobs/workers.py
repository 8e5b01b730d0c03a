"""Trainer workers that are active."""

from __future__ import annotations

from typing import NamedTuple

from surrogym_server.services.activity import Alive


class Offer(NamedTuple):
    """The largest number of real episodes that a trainer worker takes, and whether it has a reference controller."""

    most_episodes: int = 0
    reference: bool = False


class Workers(Alive[Offer]):
    """When each trainer worker was last heard of, and its offer."""

    def heard(self, surrogate: str, worker: str, offer: Offer | None = None) -> bool:
        """Note that a worker claimed or reported, and return whether it is new. None keeps its earlier offer."""
        if offer is None:
            _, offer = self._heard.get(surrogate, {}).get(worker, (0.0, Offer()))
        return self.note(surrogate, worker, offer)

    def of(self, surrogate: str) -> dict[str, Offer]:
        """The offer of each worker heard of lately, by its name."""
        return {worker: offer for owner, worker, offer in self.alive() if owner == surrogate}
