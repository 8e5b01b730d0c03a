"""Events, and announcements between servers. The announcements use LISTEN and NOTIFY of PostgreSQL, with one thread
that sends and one that listens."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import sqlalchemy as sa

from surrogym_server.errors import Unavailable
from surrogym_server.storage.records import EventRecord
from surrogym_server.storage.sql.database import BATCH, Database
from surrogym_server.storage.sql.rows import find
from surrogym_server.storage.sql.tables import events, surrogates

if TYPE_CHECKING:
    from psycopg import Connection

NEWEST = sa.select(
    surrogates.c.name,
    sa.select(sa.func.max(events.c.id)).where(events.c.surrogate_id == surrogates.c.id).scalar_subquery(),
).where(surrogates.c.name.in_(sa.bindparam("names", expanding=True)))


class Events:
    """The storage of events of surrogates.

    Each change that may end a wait appends an event, because a claim that waits for queries or jobs looks for them
    again after each event.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._pruned = 0  # id of the newest event of all surrogates at the last call of ``prune``

    def newest(self, names: Sequence[str]) -> dict[str, int]:
        """Return the id of each surrogate's newest event, by name; 0 if it has none. Unknown surrogates are left out.

        This takes one SQL statement, whose cost does not depend on the number of events.
        """
        with self._database.read() as connection:
            return {name: id or 0 for name, id in connection.execute(NEWEST, {"names": [*names]})}

    def list(self, name: str, after: int = 0, limit: int = 1_000) -> list[EventRecord]:
        """Return up to ``limit`` events of a surrogate with an id above ``after``, in order of their ids."""
        with self._database.read() as connection:
            own = events.c.surrogate_id == find(connection, name)
            rows = connection.execute(
                sa.select(events.c.id, events.c.kind, events.c.created_at, events.c.body)
                .where(own, events.c.id > after)
                .order_by(events.c.id)
                .limit(limit)
            )
            return [EventRecord(**row._mapping) for row in rows]

    def prune(self, keep: int) -> int:
        """Remove all but the newest ``keep`` events of each surrogate. Return the number of events removed.

        Surrogates without a new event since the last call are skipped. Events are removed in many short transactions,
        so that other writers wait only briefly.
        """
        with self._database.read() as connection:
            newest = connection.execute(sa.select(sa.func.max(events.c.id))).scalar() or 0
            changed = sa.select(events.c.surrogate_id).where(events.c.id > self._pruned).distinct()
            owners = [*connection.execute(changed).scalars()]
        removed = sum(self._prune(owner, keep) for owner in owners)
        self._pruned = newest
        return removed

    def _prune(self, owner: int, keep: int) -> int:
        own = events.c.surrogate_id == owner
        with self._database.read() as connection:
            beyond = sa.select(events.c.id).where(own).order_by(events.c.id.desc()).offset(keep).limit(1)
            last = connection.execute(beyond).scalar()
        if last is None:
            return 0
        oldest = sa.select(events.c.id).where(own, events.c.id <= last).order_by(events.c.id).limit(BATCH)
        remove = sa.delete(events).where(events.c.id.in_(oldest))
        return self._database.write_in_batches(lambda connection: connection.execute(remove).rowcount)


logger = logging.getLogger(__name__)

CHANNEL = "surrogym"
QUIET_SECONDS = 30.0  # after this time without a message, the listening thread checks whether the server stops
FIRST_DELAY, LONGEST_DELAY = 0.1, 10.0  # shortest and longest time in seconds between two attempts to connect
CLOSING_SECONDS = 2.0
GAP_SECONDS = 0.05  # pause between announcements, so that several changes of a surrogate are announced as one


# Callback that gets the name of a changed surrogate, or None if announcements may have been lost.
Hear = Callable[[str | None], None]


class Announcements:
    """Messages between the servers of one database that a surrogate has changed. Thread-safe. For a database with a
    single server, nothing is sent or received.

    A message may be lost, so a receiver also has to look for changed surrogates from time to time.
    """

    def announce(self, surrogate: str) -> None:
        """Send to all other servers, soon, that a surrogate has changed. Returns at once, and never raises.

        Several unsent announcements of one surrogate are sent as one.
        """

    def listen(self, hear: Hear) -> None:
        """Call ``hear``, in a thread, for each later announcement of another server. May be called once.

        After a lost connection is restored, ``hear`` is called with None, because announcements may have been lost.
        """

    def close(self) -> None:
        """Stop sending and listening. A second call does nothing."""


class NotifiedAnnouncements(Announcements):
    """Announcements by messages of PostgreSQL (NOTIFY). Two threads send and receive them. They start only with
    ``listen``, because many programs need no announcements."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._origin = uuid4().hex
        self._waiting: dict[str, None] = {}  # names of changed surrogates still to announce, as an ordered set
        self._changed = threading.Condition()
        self._ended = threading.Event()
        self._threads: list[threading.Thread] = []

    def announce(self, surrogate: str) -> None:
        with self._changed:
            self._waiting[surrogate] = None
            self._changed.notify()

    def listen(self, hear: Hear) -> None:
        self._threads = [
            threading.Thread(target=self._send, name="announce", daemon=True),
            threading.Thread(target=self._listen, args=(hear,), name="listen", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        if not self._threads or self._ended.is_set():
            return
        self._ended.set()
        self.announce("")  # an empty message wakes both threads, so that they end
        for thread in self._threads:
            thread.join(CLOSING_SECONDS)

    def _send(self) -> None:
        while self._waiting or not self._ended.is_set():
            with self._changed:
                self._changed.wait_for(lambda: self._waiting)
                names, self._waiting = list(self._waiting), {}
            try:
                self._database.notify(CHANNEL, [f"{self._origin} {name}" for name in names])
            except Unavailable as error:
                # A lost announcement does no harm, because other servers also compare events periodically.
                logger.debug("other servers were not told of %s: %s", names, error)
            self._ended.wait(GAP_SECONDS)

    def _listen(self, hear: Hear) -> None:
        import psycopg  # imported here, because a server on SQLite does not need it

        delay, missed = FIRST_DELAY, False
        while not self._ended.is_set():
            try:
                with closing(self._database.detached()) as connection:
                    connection.execute(f"LISTEN {CHANNEL}")
                    delay = FIRST_DELAY
                    if missed:
                        hear(None)
                    self._hear_all(connection, hear)
            except (Unavailable, psycopg.Error) as error:
                logger.warning("announcements of other servers can't be received now; trying again: %s", error)
                missed = True
                self._ended.wait(delay)
                delay = min(2 * delay, LONGEST_DELAY)

    def _hear_all(self, connection: Connection[Any], hear: Hear) -> None:
        while not self._ended.is_set():
            for notice in connection.notifies(timeout=QUIET_SECONDS):
                if self._ended.is_set():
                    return
                origin, _, name = notice.payload.partition(" ")
                if origin != self._origin and name:
                    hear(name)
