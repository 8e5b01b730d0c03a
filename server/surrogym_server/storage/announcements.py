"""The part of the storage port by which the servers of one database wake each other."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

Hear = Callable[
    [str | None], None
]  # takes the name of a surrogate that changed, or None after announcements may have been lost


class Announcements(ABC):
    """Short messages between the servers of one database: something happened to a surrogate.

    They may be lost, so whoever waits for them also looks from time to time. Any thread may call.
    """

    @abstractmethod
    def announce(self, surrogate: str) -> None:
        """Tell all other servers soon that something happened to the surrogate. Returns at once, and never raises.

        Announcements of one surrogate that wait to be sent are sent once.
        """

    @abstractmethod
    def listen(self, hear: Hear) -> None:
        """Call ``hear``, in a thread, for each announcement of another server from now on. To be called once.

        After a lost connection, ``hear`` is called with None as soon as the connection is back.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop sending and listening. Closing twice is harmless."""


class Alone(Announcements):
    """Announcements for a database with a single server: none are sent, and none come."""

    def announce(self, surrogate: str) -> None:
        """Do nothing: there is no other server."""

    def listen(self, hear: Hear) -> None:
        """Do nothing: no announcement ever comes."""

    def close(self) -> None:
        """Do nothing."""
