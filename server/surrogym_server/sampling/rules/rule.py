"""Rule: the signature of the functions that may choose the queries of a round."""

from __future__ import annotations

from collections.abc import Callable

from surrogym_server.sampling.round import Round
from surrogym_shared.nouns import Query

Rule = Callable[[Round], tuple[Query, ...] | None]
"""Chooses queries, or none, which ends the design. It returns None if it does not apply: the next rule is asked."""
