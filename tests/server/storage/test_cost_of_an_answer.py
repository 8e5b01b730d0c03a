"""A claim and an answer take few statements, none of them built or counted anew: this limits how many samplers a server
can serve."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import pytest
import sqlalchemy as sa
from sqlalchemy.engine.interfaces import CacheStats

from surrogym_server.errors import UnknownSurrogate
from surrogym_server.storage.records import NewSample, Standing
from surrogym_server.storage.sql import Storage

LONG = 60.0


@dataclass
class Sent:
    statements: list[str] = field(default_factory=list)
    parameters: list[Any] = field(default_factory=list)
    compiled_anew: list[str] = field(default_factory=list)


@contextmanager
def sent() -> Iterator[Sent]:
    """The statements of SQLAlchemy that are sent meanwhile, without those that begin a transaction."""
    found = Sent()

    def note(_: object, __: object, statement: str, parameters: Any, context: Any, ___: bool) -> None:
        if context is None or context.compiled is None:
            return
        found.statements.append(statement)
        found.parameters.append(parameters)
        if context.cache_hit is not CacheStats.CACHE_HIT:
            found.compiled_anew.append(statement)

    sa.event.listen(sa.Engine, "before_cursor_execute", note)
    try:
        yield found
    finally:
        sa.event.remove(sa.Engine, "before_cursor_execute", note)


def claim_and_answer(storage: Storage, name: str, answer: Callable[..., NewSample]) -> None:
    """What a server does for one sample."""
    [query] = storage.queries.claim(name, "a", 1, LONG)
    storage.surrogates.standing(name)
    storage.samples.add(name, "a", [answer(query)])
    storage.ledger.read(name)
    storage.designs.due()
    storage.designs.hopeless()


def test_fetching_and_answering_a_query_takes_few_precompiled_sql_statements(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample]
) -> None:
    name = make(queries=4)
    claim_and_answer(storage, name, answer)
    with sent() as found:
        claim_and_answer(storage, name, answer)
    assert found.compiled_anew == []
    assert len(found.statements) <= 19


def test_reading_the_ledger_counts_only_samples_added_since_the_last_read(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample]
) -> None:
    name = make(queries=4)
    claim_and_answer(storage, name, answer)
    [last] = storage.samples.page(name, 0, 10)
    with sent() as found:
        claim_and_answer(storage, name, answer)
    counts = [
        parameters
        for statement, parameters in zip(found.statements, found.parameters, strict=True)
        if "max(samples.id)" in statement
    ]
    assert len(counts) == 1
    assert last.id in (counts[0].values() if isinstance(counts[0], dict) else counts[0])
    assert storage.ledger.read(name).total == storage.samples.count(name) == 2


def test_phase_and_pause_read_alone_equal_those_of_the_full_surrogate_record(
    storage: Storage, make: Callable[..., str]
) -> None:
    name = make()
    storage.surrogates.change(name, paused=True)
    record = storage.surrogates.get(name)
    assert storage.surrogates.standing(name) == Standing(record.id, record.phase, paused=True)
    storage.surrogates.delete(name)
    with pytest.raises(UnknownSurrogate):
        storage.surrogates.standing(name)
