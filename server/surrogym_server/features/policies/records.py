"""Records of policies, and the interface of the storage of their files.

A policy of a surrogate has a version: 1, 2, ... Its description is in the database, and its files are blobs. A blob is
stored before the row that names it, and removed after that row, so that no row names a missing blob. Blobs without a
row, which a crash can leave, are removed later.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

from surrogym_server.storage.records import JSON
from surrogym_shared.wire import FEWEST_TO_JUDGE

MAX_POLICIES = 200  # largest number of policies of a surrogate
MAX_EVALUATIONS = 100  # largest number of evaluations and reports of drift of a policy
# key in a card, or in the summary of an evaluation or a drift: role and fingerprint of the token that stored it
PUSHED_BY = "pushed_by"
DRIFT = "drift"  # key in the summary of a report of drift; summaries of episodes don't have it


@dataclass(frozen=True)
class PolicyFile:
    """A file of a policy. ``blob`` is the name of the stored file; None if it was announced but not sent, or was
    removed to free space."""

    form: str
    bytes: int
    digest: str
    blob: str | None = None
    main: bool = False  # whether this is the file that was announced when the policy was stored


@dataclass(frozen=True)
class EvaluationRecord:
    id: int
    created_at: float
    summary: JSON
    bytes: int
    digest: str
    blob: str | None  # name of the blob with the episodes; None if it was removed to free space


def judges(summary: JSON) -> bool:
    """Return whether an evaluation, given its summary, can judge a policy's promise (the interval of its return).

    It can if the evaluation has enough episodes, if the policy itself acted, if the starts were those of the
    specification, and if the original environment was the surrogate's own.
    """
    declared = summary["controller"] == "policy" and summary["declared"] and summary["own"]
    return bool(declared) and int(summary["episodes"]) >= FEWEST_TO_JUDGE


@dataclass(frozen=True)
class NewEvaluation:
    key: str
    summary: JSON
    bytes: int = 0
    digest: str = ""
    blob: str | None = None


@dataclass(frozen=True)
class PolicyRecord:
    """A policy. A copy of a policy of another surrogate, on which it was trained, has the evaluations and the reports
    of drift of both. Its ``origin`` is NAME@VERSION there; None for other policies."""

    version: int
    created_at: float
    card: JSON
    curve: list[JSON] = field(repr=False)
    files: tuple[PolicyFile, ...] = ()
    aliases: tuple[str, ...] = ()
    evaluations: tuple[EvaluationRecord, ...] = ()
    drifts: tuple[EvaluationRecord, ...] = ()  # reports of drift, which have no episodes
    origin: str | None = None


Freed = tuple[str, ...]  # names of blobs that no row refers to any more


class Blobs(ABC):
    """Interface of a storage of files, each of which has a name. A name is never used twice."""

    @abstractmethod
    def put(self, content: bytes) -> str:
        """Store the content of a file durably, and return its new name.

        Raises:
            Unavailable: the content can't be stored now.
        """

    @abstractmethod
    def get(self, name: str) -> bytes:
        """Return the content of the file with this name. Raises ``Damaged`` if it is missing or can't be read."""

    @abstractmethod
    def remove(self, names: Freed) -> None:
        """Remove the files with these names. Missing files are ignored."""

    @abstractmethod
    def older(self, seconds: float) -> set[str]:
        """Return the names of the files that were stored more than ``seconds`` ago."""
