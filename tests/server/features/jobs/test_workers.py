"""Which workers are at work."""

from __future__ import annotations

from surrogym_server.features.jobs.service import Offer, Workers
from surrogym_server.services.activity import MOST_NAMES


def test_a_worker_beyond_the_name_limit_is_not_reported_as_new():
    workers = Workers(lambda: 100.0)
    assert all(workers.heard("a", f"made up {i}", Offer()) for i in range(MOST_NAMES))
    assert not workers.heard("a", "one more", Offer()), "each would wake all who wait"
