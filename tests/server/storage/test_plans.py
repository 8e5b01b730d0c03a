"""How PostgreSQL answers the statements that samplers and pages wait for: by indexes, where tables have many rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import sqlalchemy as sa

from support.million import FIRST, fill
from support.postgresql import Postgresql
from surrogym_server.storage.sql import Storage, open_storage

SURROGATES, SAMPLES = 20, 20_000
AFTER, PAGE = 1_500, 100

pytestmark = pytest.mark.postgresql


@pytest.fixture(scope="module")
def filled(postgresql: Postgresql) -> str:
    """The address of a database with many samples. Its statistics are up to date."""
    url = postgresql.new_database()
    fill(url, SURROGATES, SAMPLES, 0, 16)
    return url


@pytest.fixture
def storage(filled: str) -> Iterator[Storage]:
    opened = open_storage(filled)
    yield opened
    opened.close()


Read = Callable[[Storage], object]


@pytest.mark.parametrize(
    ("read", "words", "indexes"),
    [
        (
            lambda storage: storage.samples.page(FIRST, AFTER, PAGE),
            ("FROM samples", "LIMIT"),
            {("samples", "ix_samples_surrogate_id_id"), ("queries", "pk_queries")},
        ),
        (
            lambda storage: storage.queries.claim(f"{FIRST}-1", "sampler", 4, 60.0),
            ("FROM queries", "FOR UPDATE SKIP LOCKED"),
            {("queries", "ix_queries_surrogate_id_status_id")},
        ),
    ],
    ids=["page", "claim"],
)
def test_sql_statements_for_paging_and_fetching_queries_use_a_postgresql_index(
    filled: str, storage: Storage, read: Read, words: tuple[str, ...], indexes: set[tuple[str, str]]
):
    [sent] = [sent for sent in statements(storage, read) if all(word in sent[0] for word in words)]
    assert scans(filled, *sent) == indexes


def test_listing_surrogates_reads_the_large_postgresql_tables_by_index(filled: str, storage: Storage):
    """The first list counts the samples for the ledgers. Later ones count those that are new."""
    assert storage.surrogates.summaries()
    found = [scan for sent in statements(storage, lambda s: s.surrogates.summaries()) for scan in scans(filled, *sent)]
    large = {(table, index) for table, index in found if table in ("samples", "queries", "leases")}
    assert {table for table, _ in large} == {"samples", "queries", "leases"}
    assert "Seq Scan" not in {index for _, index in large}


def scans(url: str, statement: str, parameters: Any) -> set[tuple[str, str]]:
    """The tables that a statement reads, each with the index, or with the kind of scan where there is none."""
    engine = sa.create_engine(url.replace("postgresql:", "postgresql+psycopg:"), poolclass=sa.NullPool)
    with engine.connect() as connection:
        explained = connection.exec_driver_sql(f"EXPLAIN (FORMAT JSON) {statement}", parameters).scalar_one()
    read = [node for node in nodes(explained[0]["Plan"]) if "Relation Name" in node]
    return {(node["Relation Name"], node.get("Index Name", node["Node Type"])) for node in read}


def statements(storage: Storage, read: Read) -> list[tuple[str, Any]]:
    """The SQL that a call sends, with its parameters."""
    sent: list[tuple[str, Any]] = []

    def note(_: object, __: object, statement: str, parameters: Any, *___: object) -> None:
        sent.append((statement, parameters))

    sa.event.listen(sa.Engine, "before_cursor_execute", note)
    try:
        assert read(storage)
    finally:
        sa.event.remove(sa.Engine, "before_cursor_execute", note)
    return sent


def nodes(plan: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """A plan and all that is below it."""
    yield plan
    for below in plan.get("Plans", ()):
        yield from nodes(below)
