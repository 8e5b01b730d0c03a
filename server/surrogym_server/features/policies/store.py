"""Storage of policies by version, with their files, evaluations and aliases, in the database."""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import InvalidInput, TooLarge
from surrogym_server.features.policies.records import (
    DRIFT,
    MAX_EVALUATIONS,
    MAX_POLICIES,
    PUSHED_BY,
    EvaluationRecord,
    Freed,
    NewEvaluation,
    PolicyFile,
    PolicyRecord,
    judges,
)
from surrogym_server.storage.records import JSON
from surrogym_server.storage.sql.database import Database, conflict_insert
from surrogym_server.storage.sql.models import require_version, resolve, unknown_policy
from surrogym_server.storage.sql.rows import append_event, find, hold
from surrogym_server.storage.sql.tables import (
    Id,
    checked,
    metadata,
    policies,
    policy_aliases,
    policy_evaluations,
    policy_key,
    surrogates,
)

policy_files = checked(
    sa.Table(
        "policy_files",
        metadata,
        sa.Column("surrogate_id", Id, primary_key=True, autoincrement=False),
        sa.Column("version", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("form", sa.Text, primary_key=True),
        # Whether the policy was first stored with this file; false for a file that was added to the policy later.
        sa.Column("main", sa.Boolean, nullable=False),
        sa.Column("bytes", sa.BigInteger, nullable=False),
        sa.Column("digest", sa.Text, nullable=False),  # SHA-256 of the file
        sa.Column("blob", sa.Text),  # name of the blob with the content; NULL: not stored
        policy_key(),
    )
)

OWNED = (policy_files, policy_evaluations)  # tables whose rows may name a blob (stored file)
# Fields of a card that differ in a policy's downloaded card: its trust is that of the moment of the download, and the
# others are not sent.
NOT_KEPT = {PUSHED_BY, "trusted", "reason", "networks", "surrogate"}


class Policies:
    """Storage of the policies of surrogates, by version.

    An argument ``which`` is a version, an alias, or ``latest``. An operation on a policy that does not exist raises
    ``UnknownPolicy``. ``Freed`` in a result are the names of stored files (blobs) that no row refers to any more.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, name: str, card: JSON, curve: list[JSON], file: PolicyFile) -> tuple[int, bool, Freed]:
        """Store a policy whose ``file`` will be sent later. Return its version, and whether it is new.

        Also returns the names of stored files (blobs) that are no longer needed.

        A version never changes. A repeat with one of its files and the same card and curve returns the stored version.
        The trust in the card may differ, because a downloaded card has that of the moment. If there are more than
        ``MAX_POLICIES`` policies, one without an alias is removed: the oldest of those that the token with the most
        policies has stored.

        Raises:
            TooLarge: the surrogate has ``MAX_POLICIES`` policies, and all have aliases.
        """
        with self._database.write() as connection:
            held = hold(connection, name)
            known = _known(connection, held.id, card, curve, file.digest)
            if known is not None:
                return known, False, ()
            version = _next_version(connection, held.id)
            place = {"surrogate_id": held.id, "version": version}
            connection.execute(sa.insert(policies).values(**place, created_at=held.now, card=card, curve=curve))
            connection.execute(sa.insert(policy_files).values(**place, **_of_file(file), main=True))
            freed = _make_place(connection, held.id, version, name)
            append_event(connection, held, "policy", version=version, what="new")
            return version, True, freed

    def list(self, name: str) -> list[PolicyRecord]:
        """Return all policies of a surrogate, newest first, without their learning curves."""
        with self._database.read() as connection:
            return _records(connection, find(connection, name), sa.true(), curves=False)

    def get(self, name: str, which: str) -> PolicyRecord:
        with self._database.read() as connection:
            surrogate = find(connection, name)
            version = resolve(connection, surrogate, name, which)
            (record,) = _records(connection, surrogate, policies.c.version == version, curves=True)
            return record

    def attach(self, name: str, version: int, file: PolicyFile, most: int) -> Freed:
        """Store a file of a policy, and return the names of stored files (blobs) that are no longer needed.

        If the files of the surrogate's policies then exceed ``most`` bytes together, files of policies without an alias
        are removed: the oldest of those that the token with the most bytes has stored. The policies themselves stay.

        Raises:
            InvalidInput: a file of this format with another hash was stored or announced for the policy.
            TooLarge: the files of policies with aliases and of this one exceed the limit.
        """
        with self._database.write() as connection:
            held = hold(connection, name)
            require_version(connection, held.id, name, version)
            own = _own(policy_files, held.id, version) & (policy_files.c.form == file.form)
            before = connection.execute(sa.select(policy_files).where(own)).one_or_none()
            if before is None:
                place = {"surrogate_id": held.id, "version": version, "main": False}
                connection.execute(sa.insert(policy_files).values(**place, **_of_file(file)))
            elif before.digest != file.digest:
                raise InvalidInput(
                    f"version {version} has another {file.form} file, and a stored file is never replaced: store a new "
                    "version"
                )
            else:
                connection.execute(sa.update(policy_files).where(own).values(**_of_file(file)))
            freed = _within(connection, held.id, version, most, name)
            append_event(connection, held, "policy", version=version, what=file.form)
            replaced = () if before is None or before.blob is None else (before.blob,)
            return (*replaced, *freed)

    def evaluate(self, name: str, version: int, new: NewEvaluation, most: int) -> tuple[EvaluationRecord, bool, Freed]:
        """Store an evaluation of a policy, once for each idempotency key. Return it, and whether it is new.

        Also returns the names of stored files (blobs) that are no longer needed. Beyond ``MAX_EVALUATIONS`` of the
        policy, older ones are removed. If the files of the surrogate's policies then exceed ``most`` bytes together,
        files of policies without an alias are removed.
        """
        table = policy_evaluations
        with self._database.write() as connection:
            held = hold(connection, name)
            require_version(connection, held.id, name, version)
            own = _own(table, held.id, version)
            known = connection.execute(sa.select(table).where(own, table.c.key == new.key)).one_or_none()
            if known is not None:
                return _evaluation(known), False, ()
            values = {"surrogate_id": held.id, "version": version, "created_at": held.now, **vars(new)}
            connection.execute(sa.insert(table).values(**values))
            stored = connection.execute(sa.select(table.c.id, table.c.summary).where(own).order_by(table.c.id))
            gone_ids = _displaced({row.id: row.summary for row in stored})
            beyond = sa.delete(table).where(own, table.c.id.in_(gone_ids)).returning(table.c.blob)
            gone = tuple(blob for blob in connection.execute(beyond).scalars() if blob is not None)
            freed = _within(connection, held.id, version, most, name)
            what = DRIFT if DRIFT in new.summary else "evaluation"
            append_event(connection, held, "policy", version=version, what=what)
            row = connection.execute(sa.select(table).where(own, table.c.key == new.key)).one()
            return _evaluation(row), True, (*gone, *freed)

    def drifts(self) -> Sequence[tuple[str, int, float]]:
        """Return the policies with a report of drift: surrogate, version, time of the latest report (s since 1970)."""
        rows = policy_evaluations.c
        statement = (
            sa.select(surrogates.c.name, rows.version, sa.func.max(rows.created_at))
            .join_from(policy_evaluations, surrogates, rows.surrogate_id == surrogates.c.id)
            .where(rows.bytes == 0)  # reports of drift, which have no episodes
            .group_by(surrogates.c.name, rows.version)
            .order_by(surrogates.c.name, rows.version)
        )
        with self._database.read() as connection:
            return [(name, int(version), float(at)) for name, version, at in connection.execute(statement)]

    def put_alias(self, name: str, alias: str, version: int) -> None:
        """Set an alias to a version; an existing alias moves to this version."""
        with self._database.write() as connection:
            held = hold(connection, name)
            require_version(connection, held.id, name, version)
            insert = conflict_insert(connection, policy_aliases)
            insert = insert.values(surrogate_id=held.id, alias=alias, version=version)
            moved = insert.on_conflict_do_update(
                index_elements=["surrogate_id", "alias"], set_={"version": insert.excluded.version}
            )
            connection.execute(moved)
            append_event(connection, held, "policy", version=version, what="alias", alias=alias)

    def drop_alias(self, name: str, alias: str) -> None:
        with self._database.write() as connection:
            held = hold(connection, name)
            own = (policy_aliases.c.surrogate_id == held.id) & (policy_aliases.c.alias == alias)
            if not connection.execute(sa.delete(policy_aliases).where(own)).rowcount:
                raise unknown_policy(name, alias)
            append_event(connection, held, "policy", what="alias", alias=alias)

    def delete(self, name: str, version: int) -> Freed:
        """Delete a policy with its evaluations and aliases. Return the names of its stored files (blobs), which can be
        removed.

        The number of the version is not used again.
        """
        with self._database.write() as connection:
            held = hold(connection, name)
            require_version(connection, held.id, name, version)
            freed = _delete(connection, held.id, [version])
            append_event(connection, held, "policy", version=version, what="deleted")
            return freed

    def blobs(self) -> set[str]:
        """Return the names of all stored files (blobs) that the policies of all surrogates need."""
        with self._database.read() as connection:
            return {
                name
                for table in OWNED
                for name in connection.execute(sa.select(table.c.blob).where(table.c.blob.is_not(None))).scalars()
            }


def _own(table: sa.Table, surrogate: int, version: int) -> sa.ColumnElement[bool]:
    return (table.c.surrogate_id == surrogate) & (table.c.version == version)


def _next_version(connection: Connection, surrogate: int) -> int:
    """Return a new version number for a policy, which was never used for this surrogate."""
    count = sa.update(surrogates).where(surrogates.c.id == surrogate)
    given = count.values(policy_versions=surrogates.c.policy_versions + 1).returning(surrogates.c.policy_versions)
    return int(connection.execute(given).scalar_one())


def _of_file(file: PolicyFile) -> dict[str, Any]:
    return {"form": file.form, "bytes": file.bytes, "digest": file.digest, "blob": file.blob}


def _known(connection: Connection, surrogate: int, card: JSON, curve: list[JSON], digest: str) -> int | None:
    """Return the newest policy version with this card, this learning curve, and a file of the hash ``digest``; None if
    there is none.

    An empty ``curve`` matches any curve, because a downloaded policy has none when it is stored again.
    """
    files = policy_files.c
    same = sa.select(files.version).where(files.surrogate_id == surrogate, files.digest == digest)
    own = (policies.c.surrogate_id == surrogate) & policies.c.version.in_(same)
    wanted = sa.select(policies.c.version, policies.c.card, policies.c.curve).where(own)
    for row in connection.execute(wanted.order_by(policies.c.version.desc())):
        if _kept(row.card) == _kept(card) and curve in ([], row.curve):
            return int(row.version)
    return None


def _kept(card: JSON) -> JSON:
    return {name: value for name, value in card.items() if name not in NOT_KEPT}


def _make_place(connection: Connection, surrogate: int, version: int, name: str) -> Freed:
    """Remove policies without an alias, except ``version``, until the surrogate has at most ``MAX_POLICIES`` policies.

    Returns the names of stored files (blobs) that are no longer needed. Raises ``TooLarge`` if too many policies have
    aliases.
    """
    own = sa.select(policies.c.version).where(policies.c.surrogate_id == surrogate)
    counts = dict.fromkeys(connection.execute(own).scalars(), 1)
    beyond = len(counts) - MAX_POLICIES
    if beyond <= 0:
        return ()
    removed = [*islice(_in_order_of_removal(connection, surrogate, version, counts), beyond)]
    if len(removed) < beyond:
        raise TooLarge(
            f"expected at most {MAX_POLICIES} policies of {name!r}, got one more, and all have aliases: remove an alias"
        )
    return _delete(connection, surrogate, removed)


def _within(connection: Connection, surrogate: int, version: int, most: int, name: str) -> Freed:
    """Remove files of policies without an alias, except ``version``, until all files have at most ``most`` bytes.

    Returns the names of stored files (blobs) that are no longer needed. Raises ``TooLarge`` if that is not enough.
    """
    sizes = _sizes(connection, surrogate)
    beyond = sum(sizes.values()) - most
    if beyond <= 0:
        return ()
    freed: list[str] = []
    for oldest in _in_order_of_removal(connection, surrogate, version, sizes):
        if beyond <= 0:
            break
        beyond -= sizes.get(oldest, 0)
        freed += _blobs(connection, surrogate, [oldest])
        for table in OWNED:
            connection.execute(sa.update(table).where(_own(table, surrogate, oldest)).values(blob=None))
    if beyond > 0:
        raise TooLarge(
            f"expected the files of {name!r}'s policies to take at most {most} bytes, got {beyond} more: delete a "
            "policy, or remove an alias"
        )
    return tuple(freed)


def _sizes(connection: Connection, surrogate: int) -> dict[int, int]:
    """Return the total size in bytes of each policy's stored files (blobs), by version."""
    sizes: defaultdict[int, int] = defaultdict(int)
    for table in OWNED:
        there = sa.select(table.c.version, table.c.bytes)
        for row in connection.execute(there.where(table.c.surrogate_id == surrogate, table.c.blob.is_not(None))):
            sizes[row.version] += row.bytes
    return sizes


def _in_order_of_removal(connection: Connection, surrogate: int, kept: int, sizes: Mapping[int, int]) -> Iterator[int]:
    """Yield the policy versions without an alias, except ``kept``, in the order in which to remove them.

    The next one is always the oldest policy of the token whose remaining policies have the largest sum of ``sizes`` (by
    version). So a token that stores very many policies displaces its own policies.
    """
    cards = sa.select(policies.c.version, policies.c.card).where(policies.c.surrogate_id == surrogate)
    senders = {row.version: row.card.get(PUSHED_BY) for row in connection.execute(cards)}
    held = Counter[str | None]()
    for version, size in sizes.items():
        held[senders[version]] += size
    left = defaultdict[str | None, deque[int]](deque)
    for version in _unaliased(connection, surrogate):
        if version != kept:
            left[senders[version]].append(version)
    while left:
        sender = max(left, key=held.__getitem__)
        version = left[sender].popleft()
        held[sender] -= sizes.get(version, 0)
        if not left[sender]:
            del left[sender]
        yield version


def _unaliased(connection: Connection, surrogate: int) -> list[int]:
    """Return the policy versions of a surrogate without an alias, oldest first."""
    aliased = sa.select(policy_aliases.c.version).where(policy_aliases.c.surrogate_id == surrogate)
    own = (policies.c.surrogate_id == surrogate) & policies.c.version.not_in(aliased)
    return list(connection.execute(sa.select(policies.c.version).where(own).order_by(policies.c.version)).scalars())


def _blobs(connection: Connection, surrogate: int, versions: Sequence[int]) -> list[str]:
    found: list[str] = []
    for table in OWNED:
        there = (table.c.surrogate_id == surrogate) & table.c.version.in_(versions) & table.c.blob.is_not(None)
        found += connection.execute(sa.select(table.c.blob).where(there)).scalars()
    return found


def _delete(connection: Connection, surrogate: int, versions: Sequence[int]) -> Freed:
    freed = _blobs(connection, surrogate, versions)
    gone = (policies.c.surrogate_id == surrogate) & policies.c.version.in_(versions)
    connection.execute(sa.delete(policies).where(gone))
    return tuple(freed)


def _records(
    connection: Connection, surrogate: int, condition: sa.ColumnElement[bool], *, curves: bool
) -> list[PolicyRecord]:
    """Return the policies of a surrogate that meet an SQL condition, newest first, with or without learning curves.

    A copy of a policy of another surrogate has the evaluations and the reports of drift of both. The number of SQL
    statements does not depend on the number of policies.
    """
    columns = [policies.c.version, policies.c.created_at, policies.c.card, *([policies.c.curve] if curves else [])]
    wanted = sa.select(*columns).where(policies.c.surrogate_id == surrogate, condition)
    rows = connection.execute(wanted.order_by(policies.c.version.desc())).all()
    files, aliases = (
        _by_version(connection.execute(sa.select(table).where(table.c.surrogate_id == surrogate).order_by(order)))
        for table, order in ((policy_files, policy_files.c.main.desc()), (policy_aliases, policy_aliases.c.alias))
    )
    origins = _origins(connection, surrogate, rows, files)
    table = policy_evaluations
    homes = {surrogate, *(origin.id for origin in origins.values())}
    evaluations: defaultdict[tuple[int, int], list[EvaluationRecord]] = defaultdict(list)
    for row in connection.execute(sa.select(table).where(table.c.surrogate_id.in_(homes)).order_by(table.c.id)):
        evaluations[row.surrogate_id, row.version].append(_evaluation(row))
    found = []
    for row in rows:
        origin, own = origins.get(row.version), evaluations[surrogate, row.version]
        there = [] if origin is None else evaluations[origin.id, origin.version]
        record = PolicyRecord(
            row.version,
            row.created_at,
            row.card,
            row.curve if curves else [],
            tuple(PolicyFile(f.form, f.bytes, f.digest, f.blob, f.main) for f in files[row.version]),
            tuple(a.alias for a in aliases[row.version]),
            *_told_apart(sorted([*own, *there], key=lambda one: one.id)),
            origin=None if origin is None else f"{origin.name}@{origin.version}",
        )
        found.append(record)
    return found


def _origins(
    connection: Connection, surrogate: int, rows: Sequence[Row[Any]], files: Mapping[int, Sequence[Row[Any]]]
) -> dict[int, Row[Any]]:
    """Return, by the version of a copy, the policy of another surrogate that it is a copy of: its card names that
    surrogate as the one of its training, which has a policy with the same file and the same promise."""
    homes = {home for row in rows if (home := row.card.get("surrogate")) is not None}
    if not homes:
        return {}
    columns: list[sa.Column[Any]] = [
        surrogates.c.id,
        surrogates.c.name,
        policies.c.version,
        policies.c.card,
        policy_files.c.digest,
    ]
    main = policy_files.c.main & (policy_files.c.version == policies.c.version)
    main &= policy_files.c.surrogate_id == policies.c.surrogate_id
    joined = sa.select(*columns).join_from(policies, surrogates, surrogates.c.id == policies.c.surrogate_id)
    joined = joined.join(policy_files, main)
    there = joined.where(surrogates.c.name.in_(homes), surrogates.c.id != surrogate)
    known = connection.execute(there.order_by(policies.c.version.desc())).all()
    found: dict[int, Row[Any]] = {}
    for row in rows:
        wanted = (row.card.get("surrogate"), files[row.version][0].digest, row.card.get("promise"))
        if same := [one for one in known if (one.name, one.digest, one.card.get("promise")) == wanted]:
            found[row.version] = same[0]
    return found


def _by_version(rows: Iterable[Row[Any]]) -> defaultdict[int, list[Row[Any]]]:
    found: defaultdict[int, list[Row[Any]]] = defaultdict(list)
    for row in rows:
        found[row.version].append(row)
    return found


def _displaced(summaries: Mapping[int, JSON]) -> list[int]:
    """Return the ids of a policy's evaluations to remove, so that ``MAX_EVALUATIONS`` remain.

    There are three kinds: reports of drift, evaluations that can judge the policy's promise (interval of its return),
    and others. The oldest of the most frequent pair of kind and token is removed first, so that many evaluations of one
    kind do not displace those of another, and a token that stores very many displaces its own.

    Args:
        summaries: summaries of the evaluations by id, oldest first.
    """
    kinds: defaultdict[tuple[bool, bool, str | None], deque[int]] = defaultdict(deque)
    for id, summary in summaries.items():
        drift = DRIFT in summary
        kinds[drift, not drift and judges(summary), summary.get(PUSHED_BY)].append(id)
    beyond = max(0, len(summaries) - MAX_EVALUATIONS)
    return [max(kinds.values(), key=len).popleft() for _ in range(beyond)]


def _told_apart(rows: Iterable[EvaluationRecord]) -> tuple[tuple[EvaluationRecord, ...], tuple[EvaluationRecord, ...]]:
    """Split records into evaluations of episodes and reports of drift."""
    both: tuple[list[EvaluationRecord], list[EvaluationRecord]] = ([], [])
    for row in rows:
        both[DRIFT in row.summary].append(row)
    return tuple(both[0]), tuple(both[1])


def _evaluation(row: Row[Any]) -> EvaluationRecord:
    return EvaluationRecord(row.id, row.created_at, row.summary, row.bytes, row.digest, row.blob)
