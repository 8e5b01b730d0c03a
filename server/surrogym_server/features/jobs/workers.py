"""The trainer workers that called recently, and which jobs they accept."""

from __future__ import annotations

from typing import NamedTuple

from surrogym_server.services.activity import Alive


class Offer(NamedTuple):
    """Which jobs a trainer worker accepts: the largest number of real episodes of an evaluation, and whether it has a
    reference controller."""

    most_episodes: int = 0
    reference: bool = False


class Workers(Alive[Offer]):
    """Time of the last call of each trainer worker, and the jobs that it accepts (its offer)."""

    def heard(self, surrogate: str, worker: str, offer: Offer | None = None) -> bool:
        """Record a claim or report of a worker, and return whether the worker is new. An ``offer`` of None keeps the
        worker's earlier offer."""
        if offer is None:
            _, offer = self._heard.get(surrogate, {}).get(worker, (0.0, Offer()))
        return self.note(surrogate, worker, offer)

    def of(self, surrogate: str) -> dict[str, Offer]:
        """Return the offers of a surrogate's workers that called recently, by the worker's name."""
        return {worker: offer for owner, worker, offer in self.alive() if owner == surrogate}
