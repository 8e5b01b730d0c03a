"""What a list shows of surrogates is what each of them says by itself, at a cost that many share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import sqlalchemy as sa

from support.queries import steps
from surrogym_server.storage.records import LogPart, NewDesign, NewModel, NewSample, SurrogateSummary
from surrogym_server.storage.sql import Storage
from surrogym_server.storage.sql.queries import MAX_ATTEMPTS

LONG = 60.0


@contextmanager
def statements() -> Iterator[list[str]]:
    """The SQL that is sent meanwhile."""
    sent: list[str] = []

    def note(_: object, __: object, statement: str, *___: object) -> None:
        sent.append(statement)

    sa.event.listen(sa.Engine, "before_cursor_execute", note)
    try:
        yield sent
    finally:
        sa.event.remove(sa.Engine, "before_cursor_execute", note)


@pytest.fixture
def worked(
    storage: Storage,
    make: Callable[..., str],
    answer: Callable[..., NewSample],
    answer_all: Callable[[str], None],
    design: Callable[..., NewDesign],
) -> list[str]:
    """Names: one with models, an evaluation and a failed lease, one with a lease that ran out, and one untouched."""
    done, left, untouched = (make(name=name) for name in ("done", "left", "untouched"))
    first, *_ = storage.queries.claim(done, "a", 1, LONG)
    storage.queries.fail(done, first.id, first.token, "unreachable")
    answer_all(done)
    lease = storage.designs.begin(done, "me", LONG)
    assert lease is not None
    storage.designs.commit(lease, design(queries=2, model=judged(0.9)))
    storage.models.add(done, judged(float("nan")))
    storage.models.add(done, judged(0.95))
    storage.ledger.report(done, 7, key="e")
    [query, *_] = storage.queries.claim(left, "a", 2, LONG)
    storage.samples.add(left, "a", [answer(query)])
    storage.queries.claim(left, "a", 1, -1.0)
    return [done, left, untouched]


def judged(confidence_index: float) -> NewModel:
    return NewModel(3, "abc", {"outputs": [], "confidence_index": confidence_index}, {}, 0.5, b"model")


def test_the_listed_summary_of_a_surrogate_equals_its_full_record(storage: Storage, worked: list[str]) -> None:
    summaries = storage.surrogates.summaries()
    assert [summary.name for summary in summaries] == worked
    for summary in summaries:
        record = storage.surrogates.get(summary.name)
        assert summary == storage.surrogates.summary(summary.name)
        assert summary.environment == "Pendulum-v1"
        assert (summary.id, summary.phase, summary.round) == (record.id, record.phase, record.round)
        assert (summary.budget, summary.target) == (record.budget, record.target)
        assert summary.ledger == storage.ledger.read(summary.name)
        assert summary.ledger.total == storage.samples.count(summary.name)
        assert summary.queries == storage.surrogates.summary(summary.name).queries
    done, left, untouched = summaries
    assert (done.model_version, done.confidence_index, left.model_version) == (3, 0.95, None)
    assert (done.ledger.evaluation, done.ledger.failed, done.ledger.unresolved) == (7, 1, 1)
    assert (left.ledger.initial, left.ledger.failed, left.ledger.unresolved) == (1, 0, 1), "expired, and not yet swept"
    assert (untouched.ledger.total, untouched.queries.pending) == (0, 3)


def test_a_nan_confidence_index_does_not_break_the_surrogate_list(storage: Storage, make: Callable[..., str]) -> None:
    storage.models.add(make(), judged(float("nan")))
    index = storage.surrogates.summaries()[0].confidence_index
    assert index is not None
    assert index != index


def test_pages_of_surrogate_summaries_cover_all_in_order(storage: Storage, make: Callable[..., str]) -> None:
    names = [make(name=f"s-{number}") for number in range(5)]
    storage.surrogates.delete(names.pop(2))
    seen: list[SurrogateSummary] = []
    while page := storage.surrogates.summaries(seen[-1].id if seen else 0, 2):
        assert len(page) <= 2
        seen += page
    assert [summary.name for summary in seen] == names
    assert {summary.queries.pending for summary in seen} == {3}


@pytest.mark.parametrize(
    "look",
    [
        lambda storage: storage.surrogates.summaries(),
        lambda storage: (storage.designs.hopeless(), storage.designs.due()),
        lambda storage: storage.models.newest(),
        lambda storage: storage.queries.sweep_expired(),
    ],
    ids=["summaries", "designer", "models", "sweeper"],
)
def test_summaries_of_many_surrogates_take_as_many_sql_statements_as_of_few(
    storage: Storage, make: Callable[..., str], look: Callable[[Storage], object]
) -> None:
    """Ten seconds for a list of a thousand is what several statements for each came to."""
    sent = []
    for count in (2, 20):
        for number in range(count):
            storage.models.add(make(name=f"s-{count}-{number}"), judged(0.9))
        with statements() as found:
            look(storage)
        sent.append(len(found))
    assert sent[0] == sent[1] <= 6


def test_a_design_without_samples_is_listed_as_failed_once_all_queries_failed(
    storage: Storage, make: Callable[..., str], by_hand: Callable[..., NewSample]
) -> None:
    hopeless, sampled, waiting = (make(queries=1, name=name) for name in ("hopeless", "sampled", "waiting"))
    storage.samples.add(sampled, "a", [by_hand()])
    for name in (sampled, hopeless):
        for _ in range(MAX_ATTEMPTS):
            assert storage.designs.hopeless() == []
            [query] = storage.queries.claim(name, "a", 1, LONG)
            storage.queries.fail(name, query.id, query.token, "no power")
    assert storage.designs.hopeless() == [hopeless]
    storage.surrogates.change(hopeless, paused=True)
    assert storage.designs.hopeless() == []
    assert storage.surrogates.summary(waiting).queries.pending == 1


def test_a_design_with_a_budget_and_no_query_or_sample_is_listed_as_not_started(
    storage: Storage, make: Callable[..., str], by_hand: Callable[..., NewSample]
) -> None:
    late, sampled = (make(queries=0, name=name, budget=0) for name in ("late", "sampled"))
    assert storage.designs.unbegun() == []
    for name in (late, sampled):
        storage.surrogates.change(name, budget=5)
    storage.samples.add(sampled, "a", [by_hand()])
    assert storage.designs.unbegun() == [late]
    for name in (late, late, sampled):  # the second time changes nothing
        storage.designs.ask_first(name, steps(np.zeros((2, 2)), np.zeros((2, 1))))
    assert storage.designs.unbegun() == []
    assert [storage.surrogates.summary(name).queries.pending for name in (late, sampled)] == [2, 0]


def test_a_second_surrogate_list_shows_every_change_since_the_first(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample]
) -> None:
    """Some numbers are kept in memory. Each kind of change that could leave them behind comes between two lists."""
    name = make(name="watched")

    def require_fresh() -> None:
        [summary] = storage.surrogates.summaries()
        assert summary.ledger == storage.ledger.read(name)
        assert summary.queries == storage.surrogates.summary(name).queries

    require_fresh()
    first, second, third = storage.queries.claim(name, "a", 3, LONG)
    require_fresh()
    storage.samples.add(name, "a", [answer(first)])
    require_fresh()
    storage.queries.fail(name, second.id, second.token, "unreachable")
    require_fresh()
    logged = [answer(third, query_id=None, lease_token=None, reward=float(reward)) for reward in range(3)]
    for batch in logged:
        storage.samples.add(name, "log", [batch], log=LogPart(complete=False))
        require_fresh()
    storage.samples.add(name, "a", [answer(third)])
    require_fresh()
    storage.surrogates.delete(name)
    make(name=name)
    require_fresh()


def test_a_second_surrogate_list_does_not_recount_samples(storage: Storage, worked: list[str]) -> None:
    before = storage.surrogates.summaries()
    with statements() as sent:
        assert storage.surrogates.summaries() == before
    counted = [statement for statement in sent if "count(*)" in statement and "GROUP BY" in statement]
    assert counted == []
