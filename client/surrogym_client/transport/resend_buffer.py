"""The last requests of a session, which are sent again if the server restores an older checkpoint of it."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from surrogym_shared.frames import Shape

MAX_BYTES = 32 * 2**20


@dataclass(frozen=True)
class Sent:
    """A request of a session, and the digest of its answer once it has been answered."""

    seq: int
    what: str
    content: bytes = field(repr=False)
    read: Callable[[bytes, Shape], tuple[int, Any]]
    timeout: float
    digest: bytes = b""


class ResendBuffer:
    """Buffer of the last answered requests of a session, in order.

    Args:
        most: number of requests to keep. Their contents take at most 32 MiB together.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._sent: deque[Sent] = deque()
        self._bytes = 0

    def keep(self, sent: Sent) -> None:
        self._sent.append(sent)
        self._bytes += len(sent.content)
        while len(self._sent) > self._most or self._bytes > MAX_BYTES:
            self._bytes -= len(self._sent.popleft().content)

    def since(self, seq: int) -> list[Sent] | None:
        """Return the requests from number ``seq`` on; None if the first of these requests are no longer kept."""
        if not self._sent or self._sent[0].seq > seq:
            return None
        return [sent for sent in self._sent if sent.seq >= seq]


def digest_of(answer: bytes) -> bytes:
    return hashlib.blake2b(answer, digest_size=16).digest()
