"""Interface of announcements, by which the servers of one database notify each other of changed surrogates."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

# Callback that gets the name of a changed surrogate, or None if announcements may have been lost.
Hear = Callable[[str | None], None]


class Announcements(ABC):
    """Messages between the servers of one database that a surrogate has changed. Thread-safe.

    A message may be lost, so a receiver also has to look for changed surrogates from time to time.
    """

    @abstractmethod
    def announce(self, surrogate: str) -> None:
        """Send to all other servers, soon, that a surrogate has changed. Returns at once, and never raises.

        Several unsent announcements of one surrogate are sent as one.
        """

    @abstractmethod
    def listen(self, hear: Hear) -> None:
        """Call ``hear``, in a thread, for each later announcement of another server. May be called once.

        After a lost connection is restored, ``hear`` is called with None, because announcements may have been lost.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop sending and listening. A second call does nothing."""


class Alone(Announcements):
    """Announcements for a database with a single server: nothing is sent or received."""

    def announce(self, surrogate: str) -> None:
        """Do nothing, because there is no other server."""

    def listen(self, hear: Hear) -> None:
        """Do nothing, because there is no other server that could send an announcement."""

    def close(self) -> None:
        """Do nothing, because nothing was opened."""
