"""The part of the storage port that keeps policies: records, and laws that are tested for every adapter.

A policy of a surrogate has a version: 1, 2, ... Its description is in the database, and its files are blobs. A blob is
stored before the row that names it, and removed after that row, so that no row names a missing blob. Blobs without a
row, which a crash can leave, are swept.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

from surrogym_server.storage.records import JSON

MAX_POLICIES = 200  # of a surrogate
MAX_EVALUATIONS = 100  # of a policy
LATEST = "latest"
PUSHED_BY = "pushed_by"  # entry of a card: who stored it


@dataclass(frozen=True)
class PolicyFile:
    """A file of a policy. ``blob`` is None if the file was announced but not sent, or was removed to make room."""

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


Freed = tuple[str, ...]  # names of blobs that no row refers to any more


class Policies(ABC):
    """Policies by version. ``which`` is a version, an alias, or ``latest``.

    An operation on a policy that does not exist raises ``UnknownPolicy``.
    """

    @abstractmethod
    def add(self, name: str, card: JSON, curve: list[JSON], file: PolicyFile) -> tuple[int, bool, Freed]:
        """Store a policy before its ``file`` is sent. Returns its version, and whether that is new.

        A version never changes. The same main file, card and curve are the same version, whoever stores them. Beyond
        ``MAX_POLICIES`` the oldest policy without an alias is removed.

        Raises:
            TooLarge: there are ``MAX_POLICIES``, and all have aliases.
        """

    @abstractmethod
    def list(self, name: str) -> list[PolicyRecord]:
        """Return all policies, newest first, without their curves."""

    @abstractmethod
    def get(self, name: str, which: str) -> PolicyRecord: ...

    @abstractmethod
    def attach(self, name: str, version: int, file: PolicyFile, most: int) -> Freed:
        """Store a file of a policy. A file of this form that was stored or announced is the same one.

        If the files of the surrogate's policies then exceed ``most`` bytes together, files of the oldest policies
        without an alias are removed first. Their descriptions stay.

        Raises:
            InvalidInput: the policy has another file of this form.
            TooLarge: the files of policies with aliases and of this one exceed the limit.
        """

    @abstractmethod
    def evaluate(self, name: str, version: int, new: NewEvaluation, most: int) -> tuple[EvaluationRecord, bool, Freed]:
        """Store an evaluation, once for each key. Returns whether it is new. Beyond ``MAX_EVALUATIONS`` the policy's
        oldest evaluation is removed. ``most`` is that of ``attach``."""

    @abstractmethod
    def put_alias(self, name: str, alias: str, version: int) -> None:
        """Let the alias point to this version, and no longer to another one."""

    @abstractmethod
    def drop_alias(self, name: str, alias: str) -> None: ...

    @abstractmethod
    def delete(self, name: str, version: int) -> Freed:
        """Remove a policy with its evaluations and aliases. Its version is never used again."""

    @abstractmethod
    def blobs(self) -> set[str]:
        """Return the names of all blobs that rows of policies refer to, of all surrogates."""


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
