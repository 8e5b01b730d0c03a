"""Rule: the signature of the functions that may choose the queries of a round."""

from __future__ import annotations

from collections.abc import Callable

from surrogym_server.sampling.round import Round
from surrogym_shared.nouns import Query

Rule = Callable[[Round], tuple[Query, ...] | None]
"""Function that returns the queries of a round, or () to end the design. If it returns None, the next rule is tried."""
