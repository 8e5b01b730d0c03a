"""Type of a rule: a function that may choose the real steps that a round of the design requests (queries)."""

from __future__ import annotations

from collections.abc import Callable

from surrogym_server.sampling.round import Round
from surrogym_shared.nouns import Query

Rule = Callable[[Round], tuple[Query, ...] | None]
"""Function that returns the queries of a round, or (), which ends the design if no earlier query is open. If it returns
None, the next rule is tried."""
