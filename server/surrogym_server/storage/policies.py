"""The part of the storage port that keeps policies: records, and laws that every adapter is tested by.

A policy of a surrogate has a version: 1, 2, ... What describes it is in the database, its files are blobs. A blob is
put before the row that names it, and removed after that row, so that a row never leads to what was never there; what a
crash leaves without a row is swept.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

from surrogym_server.storage.records import JSON

MAX_POLICIES = 200  # of a surrogate
MAX_EVALUATIONS = 100  # of a policy
LATEST = "latest"


@dataclass(frozen=True)
class PolicyFile:
    """A file of a policy. ``blob`` is None where it was announced and has not come, or was removed to make room."""

    form: str
    bytes: int
    digest: str
    blob: str | None = None
    main: bool = False  # the one that the version came with


@dataclass(frozen=True)
class EvaluationRecord:
    id: int
    created_at: float
    summary: JSON
    bytes: int
    digest: str
    blob: str | None  # of its episodes


@dataclass(frozen=True)
class NewEvaluation:
    key: str
    summary: JSON
    bytes: int
    digest: str
    blob: str


@dataclass(frozen=True)
class PolicyRecord:
    version: int
    created_at: float
    card: JSON
    curve: list[JSON] = field(repr=False)
    files: tuple[PolicyFile, ...] = ()
    aliases: tuple[str, ...] = ()
    evaluations: tuple[EvaluationRecord, ...] = ()


Freed = tuple[str, ...]  # names of blobs that no row leads to any more


class Policies(ABC):
    """Policies by version. ``which`` is a version, an alias, or ``latest``.

    An operation on a policy that is not there raises ``UnknownPolicy``.
    """

    @abstractmethod
    def add(self, name: str, card: JSON, curve: list[JSON], file: PolicyFile) -> tuple[int, bool, Freed]:
        """Store a policy whose ``file`` is to come; says its version and whether that is new.

        A main file of the same digest is the same policy: it keeps its version, and gets this card and curve. Beyond
        ``MAX_POLICIES`` the oldest without an alias goes.

        Raises:
            TooLarge: there are as many, and all have aliases.
        """

    @abstractmethod
    def list(self, name: str) -> list[PolicyRecord]:
        """All of them, newest first, without their curves."""

    @abstractmethod
    def get(self, name: str, which: str) -> PolicyRecord: ...

    @abstractmethod
    def attach(self, name: str, version: int, file: PolicyFile, most: int) -> Freed:
        """Store a file of a policy; one of the same form is replaced.

        Where the files of the surrogate's policies then have more than ``most`` bytes together, those of the oldest
        without an alias are given up first. What describes them stays.

        Raises:
            TooLarge: the files of policies with aliases and of this one have more.
        """

    @abstractmethod
    def evaluate(self, name: str, version: int, new: NewEvaluation, most: int) -> tuple[EvaluationRecord, bool, Freed]:
        """Store an evaluation, once per key; says whether it is new. Beyond ``MAX_EVALUATIONS`` the oldest of the
        policy goes. ``most`` is as of ``attach``."""

    @abstractmethod
    def put_alias(self, name: str, alias: str, version: int) -> None:
        """Let an alias lead to this version, and to no other any more."""

    @abstractmethod
    def drop_alias(self, name: str, alias: str) -> None: ...

    @abstractmethod
    def delete(self, name: str, version: int) -> Freed:
        """Remove a policy with its evaluations and aliases. Its version is never used again."""

    @abstractmethod
    def blobs(self) -> set[str]:
        """Names of all blobs that a row leads to, of all surrogates."""


class Blobs(ABC):
    """Bytes by name. A name is used once."""

    @abstractmethod
    def put(self, content: bytes) -> str:
        """Store them; durable when it returns. Gives their name.

        Raises:
            Unavailable: they can't be stored now.
        """

    @abstractmethod
    def get(self, name: str) -> bytes:
        """Raises ``Damaged`` where they are not there or can't be read."""

    @abstractmethod
    def remove(self, names: Freed) -> None:
        """Remove them; those that are not there are no error."""

    @abstractmethod
    def older(self, seconds: float) -> set[str]:
        """Names of those that were put more than so many seconds ago."""
