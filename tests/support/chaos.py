"""How much chaos: a short form in every test run, all of it under ``make chaos``."""

from __future__ import annotations

import os

FULL = os.environ.get("CHAOS") == "full"
TIMES = os.environ.get("CHAOS_TIMES")  # a number of its own, for a machine with less time
SEED = int(os.environ.get("CHAOS_SEED", "0"))


def times(short: int, full: int) -> int:
    """How often to do something in this run."""
    return int(TIMES) if TIMES else full if FULL else short
