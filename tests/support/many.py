"""Many surrogates in one SQLite file: two are made through storage, the others are copies of their rows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import sqlalchemy as sa

from support import pendulum
from support.queries import steps
from surrogym_server.storage.records import NewDesign, NewModel, NewSample, NewSurrogate
from surrogym_server.storage.sql import Storage, open_storage
from surrogym_server.storage.sql.tables import metadata

QUERIES, MODELS, BLOB_BYTES = 8, 3, 20_000
LEASE_SECONDS = 86_400
NUMBERS = """CREATE TEMP TABLE numbers AS WITH RECURSIVE numbers(k) AS
    (SELECT 1 WHERE :last > 0 UNION ALL SELECT k + 1 FROM numbers WHERE k < :last) SELECT k FROM numbers"""
APART = 1_000  # ids of the rows of one copy and of the next


def fill(database: Path, count: int) -> None:
    """Make a database of ``count`` surrogates, an even number: half are finished, half wait for a sampler."""
    storage = open_storage(f"sqlite:///{database}")
    try:
        finish(storage, "finished")
        wait(storage, "waiting")
    finally:
        storage.close()
    engine = sa.create_engine(f"sqlite:///{database}")
    with engine.begin() as connection:
        connection.execute(sa.text(NUMBERS), {"last": count // 2 - 1})
        for table in metadata.sorted_tables:
            connection.execute(sa.insert(table).from_select(table.c.keys(), copies(table)))
    engine.dispose()


def copies(table: sa.Table) -> sa.Select[tuple[object, ...]]:
    """The rows of a table once more for each number, with ids and names of their own."""
    k = sa.column("k", sa.Integer)
    owners = {table.c.id} if table.name == "surrogates" else {table.c.get("surrogate_id")}

    def copied(column: sa.Column[object]) -> sa.ColumnElement[object]:
        if column in owners:
            return column + 2 * k
        if column.name in ("id", "query_id", "lease_id"):
            return column + APART * k
        if column.unique:
            return column.concat(sa.cast(k, sa.Text))
        return column

    return sa.select(*(copied(column) for column in table.c)).select_from(table.join(sa.table("numbers"), sa.true()))


def wait(storage: Storage, name: str) -> None:
    """A surrogate with open queries; one lease has failed, another holds."""
    create(storage, name)
    failed, _ = storage.queries.claim(name, "sampler", 2, LEASE_SECONDS)
    storage.queries.fail(name, failed.id, failed.token, "the motor did not answer")


def finish(storage: Storage, name: str) -> None:
    """A surrogate whose design is ready, with an evaluation in its ledger."""
    create(storage, name)
    for query in storage.queries.claim(name, "sampler", QUERIES, LEASE_SECONDS):
        sample = NewSample(query.coordinates, query.action, query.coordinates, 0.5, terminated=False)
        storage.samples.add(name, "sampler", [replace(sample, query_id=query.id, lease_token=query.token)])
    for _ in range(MODELS - 1):
        storage.models.add(name, model())
    lease = storage.designs.begin(name, "fill", LEASE_SECONDS)
    assert lease is not None
    storage.designs.commit(lease, NewDesign(model(), {"round": 1}, "ready"))
    storage.ledger.report(name, 200, key="evaluation")


def create(storage: Storage, name: str) -> None:
    queries = steps(np.zeros((QUERIES, 2)), np.zeros((QUERIES, 1)))
    storage.surrogates.create(NewSurrogate(name, pendulum.spec(), 40, 0.999, queries))


def model() -> NewModel:
    output = {
        "structure": "gaussian on sines",
        "confidence_index": 0.99,
        "confidence_index_paper": 0.99,
        "tolerance": 0.01,
        "coverage": 1.0,
        "leave_one_out_error": 0.005,
    }
    indices = {"confidence_index": 0.99, "confidence_index_paper": 0.99, "target": 0.999, "samples": QUERIES}
    fidelity = {**indices, "outputs": [{"name": name, **output} for name in ("theta", "theta_dot", "reward")]}
    return NewModel(QUERIES, "0" * 64, fidelity, {"outputs": []}, 0.1, bytes(BLOB_BYTES))
