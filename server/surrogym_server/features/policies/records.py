"""Records of policies, and the port of their files.

A policy of a surrogate has a version: 1, 2, ... Its description is in the database, and its files are blobs. A blob is
stored before the row that names it, and removed after that row, so that no row names a missing blob. Blobs without a
row, which a crash can leave, are swept.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

from surrogym_server.storage.records import JSON
from surrogym_shared.wire import FEWEST_TO_JUDGE

MAX_POLICIES = 200  # of a surrogate
MAX_EVALUATIONS = 100  # of a policy
PUSHED_BY = "pushed_by"  # entry of a card: who stored it
DRIFT = "drift"  # entry of the summary of a report that the plant has drifted; other summaries are of episodes
OLDER: JSON = {
    "environment": "",
    "own": True,
    "seeded": True,
}  # of evaluations that were stored before these fields existed


@dataclass(frozen=True)
class PolicyFile:
    """A file of a policy. ``blob`` is None if the file was announced but not sent, or was removed to free space."""

    form: str
    bytes: int
    digest: str
    blob: str | None = None
    main: bool = False  # the file with which the version was created


@dataclass(frozen=True)
class EvaluationRecord:
    id: int
    created_at: float
    summary: JSON
    bytes: int
    digest: str
    blob: str | None  # of its episodes


def judges(summary: JSON) -> bool:
    """Return whether episodes can judge a promise: enough of them, by the policy, as declared, in its own plant."""
    there = OLDER | summary
    declared = there.get("controller") == "policy" and there.get("declared") and there["own"]
    return bool(declared) and int(there["episodes"]) >= FEWEST_TO_JUDGE


@dataclass(frozen=True)
class NewEvaluation:
    key: str
    summary: JSON
    bytes: int = 0
    digest: str = ""
    blob: str | None = None


@dataclass(frozen=True)
class PolicyRecord:
    version: int
    created_at: float
    card: JSON
    curve: list[JSON] = field(repr=False)
    files: tuple[PolicyFile, ...] = ()
    aliases: tuple[str, ...] = ()
    evaluations: tuple[EvaluationRecord, ...] = ()
    drifts: tuple[EvaluationRecord, ...] = ()  # without episodes


Freed = tuple[str, ...]  # names of blobs that no row refers to any more


class Blobs(ABC):
    """Bytes by name. A name is used once."""

    @abstractmethod
    def put(self, content: bytes) -> str:
        """Store bytes durably, and return their name.

        Raises:
            Unavailable: they can't be stored now.
        """

    @abstractmethod
    def get(self, name: str) -> bytes:
        """Return the bytes. Raises ``Damaged`` if they are missing or can't be read."""

    @abstractmethod
    def remove(self, names: Freed) -> None:
        """Remove blobs. Missing ones are ignored."""

    @abstractmethod
    def older(self, seconds: float) -> set[str]:
        """Return the names of the blobs that are older than a number of seconds."""
