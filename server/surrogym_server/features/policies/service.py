"""Policies: stored with their trainings and evaluations, and returned unchanged."""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import statistics
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Self

from prometheus_client import Metric
from prometheus_client.core import GaugeMetricFamily

from surrogym_server.errors import Damaged, Forbidden, InvalidInput, NotThere, SpecConflict, UnknownPolicy
from surrogym_server.feature import Core
from surrogym_server.features.policies.blobs import open_blobs
from surrogym_server.features.policies.file_checks import check_file
from surrogym_server.features.policies.records import (
    DRIFT,
    PUSHED_BY,
    Blobs,
    EvaluationRecord,
    NewEvaluation,
    PolicyFile,
    PolicyRecord,
)
from surrogym_server.features.policies.store import Policies
from surrogym_server.services.notices import Notices
from surrogym_server.services.surrogates import Complete, difference, short
from surrogym_server.storage.port import LATEST, Storage
from surrogym_server.storage.records import JSON
from surrogym_shared import intervals
from surrogym_shared.checks import trace_fault
from surrogym_shared.environments import is_name, is_same

logger = logging.getLogger(__name__)

MEBIBYTE = 2**20
ORPHAN_SECONDS = 3_600.0  # wait before unreferenced files are removed; an upload takes less
MUST_AGREE = ("observation", "action")  # of two specifications: a policy's inputs and outputs


@dataclass(frozen=True)
class Episodes:
    """Real episodes of a report; lists have one entry for each episode."""

    controller: str
    note: str
    declared: bool
    environment: str
    seeded: bool
    first_seed: int
    returns: Sequence[float]
    lengths: Sequence[int]
    success: Sequence[bool] | None
    traces: Sequence[JSON]


class PolicyService:
    def __init__(self, storage: Storage, blobs: Blobs, complete: Complete, notices: Notices, most_bytes: int) -> None:
        """Args:
        storage: holds the policies.
        blobs: holds their files.
        complete: returns a specification with every field that this program knows, as JSON.
        notices: of this process.
        most_bytes: limit for all files of one surrogate's policies."""
        self._storage = storage
        self._policies = storage.part(Policies)
        self._blobs = blobs
        self._complete = complete
        self._notices = notices
        self._most_bytes = most_bytes
        self._looked_at_files = -ORPHAN_SECONDS

    @classmethod
    def start(cls, core: Core) -> Self:
        settings = core.settings
        blobs = open_blobs(core.storage, settings.database_url, settings.files)
        return cls(core.storage, blobs, core.complete, core.notices, settings.policies_mib * MEBIBYTE)

    async def sweep(self) -> None:
        """Once in ``ORPHAN_SECONDS``, remove the files whose policy or surrogate was deleted or never stored."""
        await asyncio.to_thread(self._sweep_files)

    def metrics(self) -> Iterator[Metric]:
        """When drift was last found, for each policy of which it was."""
        words = "When real steps last disagreed with the model of a policy, in seconds since 1970."
        family = GaugeMetricFamily("surrogym_policy_drift_time_seconds", words, labels=("surrogate", "version"))
        for name, version, at in self._policies.drifts():
            family.add_metric([name, str(version)], at)
        yield family

    def add(self, name: str, card: JSON, curve: list[JSON], file: PolicyFile, by: str) -> tuple[PolicyRecord, bool]:
        """Store a policy before its file is sent. Returns it, and whether it is new: a policy with the same file, card
        and curve is known. ``by`` says who stores it.

        Raises:
            SpecConflict: it was made for a specification with other observations or actions.
        """
        differs = self._difference(name, card["spec"])
        kept = {**card, "spec": card["spec"] if differs else None, "differs": differs, PUSHED_BY: by}
        version, created, freed = self._policies.add(name, kept, curve, file)
        self._changed(name, freed)
        return self._policies.get(name, str(version)), created

    def list(self, name: str) -> list[PolicyRecord]:
        """All policies, newest first."""
        return self._policies.list(name)

    def get(self, name: str, which: str) -> PolicyRecord:
        """Return a policy. Raises ``UnknownPolicy``."""
        return self._policies.get(name, which)

    def put_file(
        self, name: str, version: int, file: PolicyFile, content: bytes, by: str | None = None
    ) -> PolicyRecord:
        """Store an announced file. ``add`` announces a policy's own file. ``by`` says who sends it; None may add to any
        policy.

        Raises:
            Forbidden: somebody else stored the policy.
            InvalidInput: it differs from the announcement, or does not have its form.
            TooLarge: there is no room for it.
        """
        record = self._policies.get(name, str(version))
        owner = record.card.get(PUSHED_BY, by)
        if by not in (None, owner):
            raise Forbidden(f"expected the token that stored version {version}, {owner}, or an admin's, got {by}")
        own = next((known for known in record.files if known.form == file.form and known.main), None)
        if own is not None and own.digest != file.digest:
            raise InvalidInput(f"expected the file that version {version} was announced with, got a different file")
        check_file(file.form, content, file.bytes, file.digest)
        blob = self._blobs.put(content)
        with self._removed_if_refused(blob):
            stored = PolicyFile(file.form, file.bytes, file.digest, blob)
            freed = self._policies.attach(name, version, stored, self._most_bytes)
        self._changed(name, freed)
        return self._policies.get(name, str(version))

    def file(self, name: str, which: str, form: str) -> tuple[int, bytes]:
        """Return a file, and the version to which it belongs.

        Raises:
            UnknownPolicy: there is no such policy, or it has no such file.
            Damaged: the file has changed since it was stored.
        """
        record = self._policies.get(name, which)
        place = f"version {record.version} of {name!r}'s policies"
        file = next((one for one in record.files if one.form == form and one.blob is not None), None)
        if file is None:
            there = ", ".join(one.form for one in record.files if one.blob is not None) or "none"
            raise UnknownPolicy(f"expected one of the files of {place} ({there}), got {form!r}")
        return record.version, self._content(file.blob, file.digest, f"the {form} file of {place}")

    def evaluate(self, name: str, version: int, episodes: Episodes, key: str) -> tuple[PolicyRecord, EvaluationRecord]:
        """Store real episodes of a policy, once for each key. Returns the policy and the evaluation.

        Raises:
            InvalidInput: lists of different lengths.
            TooLarge: there is no room for it.
        """
        _require_lengths(episodes, self._storage.surrogates.get(name).spec)
        episodewise = {name: getattr(episodes, name) for name in ("returns", "lengths", "success", "traces")}
        content = json.dumps(episodewise, separators=(",", ":")).encode()
        digest = hashlib.sha256(content).hexdigest()
        blob = self._blobs.put(content)
        summary = {**_summary(episodes), "own": self._is_own(name, episodes.environment)}
        new = NewEvaluation(key, summary, len(content), digest, blob)
        with self._removed_if_refused(blob):
            stored, created, freed = self._policies.evaluate(name, version, new, self._most_bytes)
        self._changed(name, freed if created else (blob,))
        return self._policies.get(name, str(version)), stored

    def report_drift(self, name: str, version: int, drift: JSON, key: str) -> PolicyRecord:
        """Store that the plant has drifted, once for each key, which withdraws the trust. Returns the policy."""
        new = NewEvaluation(f"{DRIFT} {key}", {DRIFT: drift})
        _, created, freed = self._policies.evaluate(name, version, new, self._most_bytes)
        if created:
            self._changed(name, freed)
        return self._policies.get(name, str(version))

    def episodes(
        self, name: str, which: str, id: int
    ) -> tuple[PolicyRecord, EvaluationRecord, JSON | None, str | None]:
        """Return an evaluation and its episodes, or why these are missing.

        Raises:
            UnknownPolicy: there is no such policy, or it has no such evaluation.
        """
        record = self._policies.get(name, which)
        found = next((one for one in record.evaluations if one.id == id), None)
        if found is None:
            raise UnknownPolicy(f"expected an evaluation of version {record.version} of {name!r}'s policies, got {id}")
        if found.blob is None:
            return record, found, None, "they were removed to free space for newer files"
        try:
            content = self._content(found.blob, found.digest, f"the episodes of evaluation {id}")
            return record, found, json.loads(content), None
        except Damaged as error:
            return record, found, None, str(error)

    def put_alias(self, name: str, alias: str, version: int) -> PolicyRecord:
        """Let an alias point to a version. Raises ``UnknownPolicy``, or ``InvalidInput`` for the reserved alias of the
        newest."""
        if alias == LATEST:
            raise InvalidInput(
                f"expected another alias than {LATEST!r}, which is always the newest version: choose another word"
            )
        self._policies.put_alias(name, alias, version)
        self._changed(name)
        return self._policies.get(name, alias)

    def drop_alias(self, name: str, alias: str) -> None:
        """Remove an alias. Raises ``UnknownPolicy``."""
        self._policies.drop_alias(name, alias)
        self._changed(name)

    def delete(self, name: str, version: int) -> None:
        """Remove a policy with its files and evaluations. Raises ``UnknownPolicy``."""
        self._changed(name, self._policies.delete(name, version))

    def _sweep_files(self) -> None:
        now = time.monotonic()
        if now - self._looked_at_files < ORPHAN_SECONDS:
            return
        self._looked_at_files = now
        old = self._blobs.older(ORPHAN_SECONDS)
        orphans = tuple(sorted(old - self._policies.blobs())) if old else ()
        self._blobs.remove(orphans)
        if orphans:
            logger.info("files removed that belonged to deleted policies: %d", len(orphans))

    @contextmanager
    def _removed_if_refused(self, blob: str) -> Iterator[None]:
        """Remove a blob if its row was refused.

        After a lost connection it is unknown whether the row was stored, and a row must not point to a missing blob. So
        the blob stays then, and is swept later if there is no row.
        """
        try:
            yield
        except (InvalidInput, NotThere):
            self._blobs.remove((blob,))
            raise

    def _content(self, blob: str | None, digest: str, what: str) -> bytes:
        assert blob is not None
        content = self._blobs.get(blob)
        if hashlib.sha256(content).hexdigest() != digest:
            raise Damaged(f"{what} has changed since it was stored: its digest differs")
        return content

    def _is_own(self, name: str, environment: str) -> bool:
        """Whether a name means the surrogate's own environment.

        A specification may call the environment by free text, which no name of an evaluation can equal. Then the name
        in the surrogate's first evaluation is its own.
        """
        own = str(self._storage.surrogates.get(name).spec["environment"])
        if not is_name(own):
            known = (one for policy in self._policies.list(name) for one in policy.evaluations)
            named = [(one.id, one.summary["environment"]) for one in known if one.summary.get("environment")]
            own = min(named)[1] if named else environment
        return not environment or is_same(environment, own)

    def _difference(self, name: str, spec: JSON | None) -> str | None:
        """Name the part in which the specification of a card differs from the surrogate's."""
        own = self._complete(self._storage.surrogates.get(name).spec)
        if spec is None or own == spec:
            return None
        for part in MUST_AGREE:
            if own[part] != spec[part]:
                where, had, got = difference(own[part], spec[part])
                place = f"{part}.{where}".rstrip(".")
                raise SpecConflict(
                    f"expected a policy for {name!r}, got one for another specification: {place} is "
                    f"{short(had)} there, {short(got)} in the policy's card"
                )
        return difference(own, spec)[0]

    def _changed(self, name: str, freed: tuple[str, ...] = ()) -> None:
        self._blobs.remove(freed)
        self._notices.post(name)


def _require_lengths(episodes: Episodes, spec: JSON) -> None:
    """Check that lists belong together, and that traces have the specification's numbers of coordinates and actions."""
    count = len(episodes.returns)
    for what in ("lengths", "success"):
        values = getattr(episodes, what)
        if values is not None and len(values) != count:
            raise InvalidInput(f"{what}: expected {count} entries, one for each return, got {len(values)}")
    action = spec["action"]
    sizes = {"c": len(spec["coordinates"]), "f": len(action.get("low") or action.get("nvec") or (0,))}
    for number, trace in enumerate(episodes.traces):
        if fault := trace_fault(trace["coordinates"], trace["action"], trace["reward"], **sizes):
            raise InvalidInput(f"traces.{number}: {fault}")


def _summary(episodes: Episodes) -> JSON:
    """Statistics of the episodes, with intervals of 95 %."""
    returns, success = list(episodes.returns), episodes.success
    share = None if success is None else intervals.of_share(sum(success), len(success))
    interval = intervals.of_mean(returns)
    return {
        "controller": episodes.controller,
        "note": episodes.note,
        "declared": episodes.declared,
        "environment": episodes.environment,
        "seeded": episodes.seeded,
        "first_seed": episodes.first_seed,
        "episodes": len(returns),
        "steps": sum(episodes.lengths),
        "mean": statistics.fmean(returns),
        "mean_interval": None if interval is None else interval._asdict(),
        "median": statistics.median_low(returns),  # the return of an episode, which is shown as the median one
        "least": min(returns),
        "most": max(returns),
        "success_rate": None if not success else sum(success) / len(success),
        "success_interval": None if share is None else share._asdict(),
    }
