"""The service of policies: it stores them with files and evaluations, returns them, and records aliases and drift. A
file is checked without loading anything from it, neither arrays nor objects nor code."""

from __future__ import annotations

import asyncio
import hashlib
import io
import json
import logging
import statistics
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Self

from prometheus_client import Metric
from prometheus_client.core import GaugeMetricFamily

from surrogym_server.errors import Damaged, Forbidden, InvalidInput, NotThere, SpecConflict, UnknownPolicy
from surrogym_server.feature import Core, Service
from surrogym_server.features.policies.blobs import open_blobs
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
from surrogym_server.features.policies.webhook import Webhook
from surrogym_server.services.notices import Notices
from surrogym_server.services.surrogates import Complete, difference, short
from surrogym_server.storage.records import JSON
from surrogym_server.storage.sql import Storage
from surrogym_server.storage.sql.models import LATEST
from surrogym_shared import intervals, network
from surrogym_shared.checks import trace_fault
from surrogym_shared.environments import is_name, is_same
from surrogym_shared.limits import KeptEpisodes
from surrogym_shared.surrogate_file import PLANNER_HEAD
from surrogym_shared.wire import AddEvaluation

logger = logging.getLogger(__name__)

MEBIBYTE = 2**20
ORPHAN_SECONDS = 3_600.0  # age from which a file that no policy names is removed; an upload takes less time
# Fields in which the specification in a policy's card (its description) must equal that of the surrogate.
MUST_AGREE = ("observation", "action")
# Fields of a reported evaluation that its summary repeats.
DESCRIPTION = {"controller", "note", "declared", "environment", "seeded", "first_seed"}


class PolicyService(Service):
    def __init__(
        self,
        storage: Storage,
        blobs: Blobs,
        complete: Complete,
        notices: Notices,
        most_bytes: int,
        webhook: Webhook | None = None,
    ) -> None:
        """Keep the objects of the server that this service needs.

        Args:
            storage: stores the policies.
            blobs: stores the files of the policies.
            complete: adds the fields that a specification (JSON) of an older program lacks.
            notices: notices of this process.
            most_bytes: largest size of all files of one surrogate's policies together.
            webhook: receives each report of drift; None: nothing does.
        """
        self._storage = storage
        self._policies = storage.part(Policies)
        self._blobs = blobs
        self._complete = complete
        self._notices = notices
        self._most_bytes = most_bytes
        self._webhook = webhook
        self._looked_at_files = -ORPHAN_SECONDS

    @classmethod
    def start(cls, core: Core) -> Self:
        settings = core.settings
        blobs = open_blobs(core.storage, settings.database_url, settings.files)
        webhook = None if settings.drift_webhook is None else Webhook(settings.drift_webhook)
        return cls(core.storage, blobs, core.complete, core.notices, settings.policies_mib * MEBIBYTE, webhook)

    async def sweep(self) -> None:
        """Every ``ORPHAN_SECONDS``, remove files whose policy was deleted or never stored."""
        await asyncio.to_thread(self._sweep_files)

    def metrics(self) -> Iterator[Metric]:
        """Yield a metric with the time of the last report of drift, for each policy that has one."""
        words = "When real steps last disagreed with the model of a policy, in seconds since 1970."
        family = GaugeMetricFamily("surrogym_policy_drift_time_seconds", words, labels=("surrogate", "version"))
        for name, version, at in self._policies.drifts():
            family.add_metric([name, str(version)], at)
        yield family

    def add(self, name: str, card: JSON, curve: list[JSON], file: PolicyFile, by: str) -> tuple[PolicyRecord, bool]:
        """Store a policy whose file will be sent later. Return it, and whether it is new.

        A policy with the same file, card and curve as a stored one is not new.

        Args:
            name: name of the surrogate.
            card: what the policy's file says about its training, as JSON.
            curve: learning curve of the training.
            file: the announced file.
            by: role and fingerprint of the token that stores the policy.

        Raises:
            SpecConflict: the policy was trained for other observations or actions.
        """
        differs = self._difference(name, card["spec"])
        kept = {**card, "spec": card["spec"] if differs else None, "differs": differs, PUSHED_BY: by}
        version, created, freed = self._policies.add(name, kept, curve, file)
        self._changed(name, freed)
        return self._policies.get(name, str(version)), created

    def list(self, name: str) -> list[PolicyRecord]:
        """Return all policies of a surrogate, newest first."""
        return self._policies.list(name)

    def get(self, name: str, which: str) -> PolicyRecord:
        """Return a policy by its version, an alias, or ``latest``. Raises ``UnknownPolicy``."""
        return self._policies.get(name, which)

    def put_file(
        self, name: str, version: int, file: PolicyFile, content: bytes, by: str | None = None
    ) -> PolicyRecord:
        """Store a file of a policy, and return the policy.

        Args:
            name: name of the surrogate.
            version: version of the policy.
            file: format, size and hash of the file. The main file, which ``add`` announced, must have the hash that it
                was announced with.
            content: the file.
            by: role and fingerprint of the token that sends the file; None for an admin.

        Raises:
            Forbidden: another token stored the policy.
            InvalidInput: the content differs from ``file``, or does not have its format.
            TooLarge: the files of the surrogate's policies would exceed their limit.
        """
        record = self._policies.get(name, str(version))
        owner = record.card.get(PUSHED_BY, by)
        if by not in (None, owner):
            raise Forbidden(
                f"only {owner}, who stored version {version}, or an admin may add files; got {by}: use one of these "
                "tokens"
            )
        own = next((known for known in record.files if known.form == file.form and known.main), None)
        if own is not None and own.digest != file.digest:
            raise InvalidInput(
                f"expected the file that version {version} was announced with, got a different file: send that file "
                "or store a new version"
            )
        check_file(file.form, content, file.bytes, file.digest)
        blob = self._blobs.put(content)
        with self._removed_if_refused(blob):
            stored = PolicyFile(file.form, file.bytes, file.digest, blob)
            freed = self._policies.attach(name, version, stored, self._most_bytes)
        self._changed(name, freed)
        return self._policies.get(name, str(version))

    def file(self, name: str, which: str, form: str) -> tuple[int, bytes]:
        """Return the version of a policy, and its file of the format ``form``.

        Raises:
            UnknownPolicy: there is no such policy, or it has no such file.
            Damaged: the file has changed since it was stored.
        """
        record = self._policies.get(name, which)
        place = f"version {record.version} of {name!r}'s policies"
        file = next((one for one in record.files if one.form == form and one.blob is not None), None)
        if file is None:
            there = ", ".join(one.form for one in record.files if one.blob is not None) or "none"
            raise UnknownPolicy(
                f"expected the format of a stored file of {place} (stored: {there}), got {form!r}: choose a stored one"
            )
        return record.version, self._content(file.blob, file.digest, f"the {form} file of {place}")

    def evaluate(
        self, name: str, version: int, episodes: AddEvaluation, by: str
    ) -> tuple[PolicyRecord, EvaluationRecord]:
        """Store real episodes of a policy, once for each idempotency key. Return the policy and the evaluation. ``by``
        is the token that sent them.

        Raises:
            InvalidInput: the lists have different lengths, or a trace does not fit the specification.
            TooLarge: the files of the surrogate's policies would exceed their limit.
        """
        spec = self._storage.surrogates.get(name).spec
        _require_lengths(episodes, spec)
        episodewise = episodes.model_dump(mode="json", include={"returns", "lengths", "success", "traces"})
        content = json.dumps(episodewise, separators=(",", ":")).encode()
        digest = hashlib.sha256(content).hexdigest()
        blob = self._blobs.put(content)
        summary = {**_summary(episodes), "own": self._is_own(name, episodes.environment), PUSHED_BY: by}
        if episodes.limits is not None and spec.get("limits"):
            kept = KeptEpisodes(
                episodes=len(episodes.returns),
                steps=sum(episodes.lengths),
                probability=spec["limits"]["probability"],
                least_room={},
                **episodes.limits.model_dump(),
            )
            summary["limits"] = _limits(kept, self._policies.get(name, str(version)).card)
        new = NewEvaluation(episodes.idempotency_key, summary, len(content), digest, blob)
        with self._removed_if_refused(blob):
            stored, created, freed = self._policies.evaluate(name, version, new, self._most_bytes)
        self._changed(name, freed if created else (blob,))
        return self._policies.get(name, str(version)), stored

    def report_drift(self, name: str, version: int, drift: JSON, key: str, by: str) -> PolicyRecord:
        """Store a report of drift from the token ``by``, once for each idempotency key, and return the policy, whose
        promise is then not trusted."""
        new = NewEvaluation(f"{DRIFT} {key}", {DRIFT: drift, PUSHED_BY: by})
        _, created, freed = self._policies.evaluate(name, version, new, self._most_bytes)
        if created:
            self._changed(name, freed)
            if self._webhook is not None:
                self._webhook.post({"event": "drift", "surrogate": name, "policy_version": version, **drift})
        return self._policies.get(name, str(version))

    def episodes(
        self, name: str, which: str, id: int
    ) -> tuple[PolicyRecord, EvaluationRecord, JSON | None, str | None]:
        """Return a policy, an evaluation of it, the evaluation's episodes, and the reason if these can't be read.

        Raises:
            UnknownPolicy: there is no such policy, or it has no such evaluation.
        """
        record = self._policies.get(name, which)
        found = next((one for one in record.evaluations if one.id == id), None)
        if found is None:
            raise UnknownPolicy(
                f"expected the id of an evaluation of version {record.version} of {name!r}'s policies, got {id}, which "
                "does not exist"
            )
        if found.blob is None:
            return record, found, None, "they were removed to free space for newer files"
        try:
            content = self._content(found.blob, found.digest, f"the episodes of evaluation {id}")
            return record, found, json.loads(content), None
        except Damaged as error:
            return record, found, None, str(error)

    def put_alias(self, name: str, alias: str, version: int) -> PolicyRecord:
        """Set an alias to a version, and return the policy.

        Raises:
            UnknownPolicy: there is no policy of this version.
            InvalidInput: the alias is ``latest``, which is reserved.
        """
        if alias == LATEST:
            raise InvalidInput(
                f"expected another alias than {LATEST!r}, which is always the newest version: choose another word"
            )
        self._policies.put_alias(name, alias, version)
        self._changed(name)
        return self._policies.get(name, alias)

    def drop_alias(self, name: str, alias: str) -> None:
        """Remove an alias of a policy. Raises ``UnknownPolicy`` if the alias does not exist."""
        self._policies.drop_alias(name, alias)
        self._changed(name)

    def delete(self, name: str, version: int) -> None:
        """Delete a policy with its files, evaluations and aliases. Raises ``UnknownPolicy``."""
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
        """Return a context in which the database stores a row that names a file, ``blob``. If it refuses the row, the
        file is removed.

        If the connection is lost, it is unknown whether the row was stored, so the file stays. If there is no row, a
        later sweep removes the file.
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
            raise Damaged(f"{what} has changed since it was stored, as its digest shows: restore it from a backup")
        return content

    def _is_own(self, name: str, environment: str) -> bool:
        """Whether ``environment``, the name in an evaluation, is the surrogate's own original environment.

        If the specification describes its environment by free text instead of a name, the name in the surrogate's first
        evaluation counts as its own. An empty name counts as its own too.
        """
        own = str(self._storage.surrogates.get(name).spec["environment"])
        if not is_name(own):
            known = (one for policy in self._policies.list(name) if not policy.origin for one in policy.evaluations)
            named = [(one.id, one.summary["environment"]) for one in known if one.summary.get("environment")]
            own = min(named)[1] if named else environment
        return not environment or is_same(environment, own)

    def _difference(self, name: str, spec: JSON | None) -> str | None:
        """Return the first field in which the specification of a policy's card differs from that of the surrogate.

        Returns None if both are equal, or if the card has no specification. Raises ``SpecConflict`` if the observations
        or actions differ.
        """
        own = self._complete(self._storage.surrogates.get(name).spec)
        if spec is None or own == spec:
            return None
        for part in MUST_AGREE:
            if own[part] != spec[part]:
                where, had, got = difference(own[part], spec[part])
                place = f"{part}.{where}".rstrip(".")
                raise SpecConflict(
                    f"expected a policy for {name!r}, got one for another specification: {place} is {short(had)} in "
                    f"the surrogate's, {short(got)} in the policy's card; store it with the surrogate that it was "
                    "trained on"
                )
        return difference(own, spec)[0]

    def _changed(self, name: str, freed: tuple[str, ...] = ()) -> None:
        self._blobs.remove(freed)
        self._notices.post(name)


def _require_lengths(episodes: AddEvaluation, spec: JSON) -> None:
    """Check the lengths of an evaluation's lists, and that its traces have the sizes of the specification's coordinates
    and actions. Raises ``InvalidInput``."""
    count = len(episodes.returns)
    for what in ("lengths", "success"):
        values = getattr(episodes, what)
        if values is not None and len(values) != count:
            raise InvalidInput(
                f"{what}: expected {count} entries, one for each episode, as many as `returns` has, got {len(values)}"
            )
    action = spec["action"]
    sizes = {"c": len(spec["coordinates"]), "f": len(action.get("low") or action.get("nvec") or (0,))}
    for number, trace in enumerate(episodes.traces):
        if fault := trace_fault(trace.coordinates, trace.action, trace.reward, **sizes):
            raise InvalidInput(f"traces.{number}: {fault}")


def _summary(episodes: AddEvaluation) -> JSON:
    """Return statistics of an evaluation's episodes, with 95 % intervals, as JSON."""
    returns, success = episodes.returns, episodes.success
    share = None if success is None else intervals.of_share(sum(success), len(success))
    interval = intervals.of_mean(returns)
    return {
        **episodes.model_dump(include=DESCRIPTION),
        "episodes": len(returns),
        "steps": sum(episodes.lengths),
        "mean": statistics.fmean(returns),
        "mean_interval": None if interval is None else interval._asdict(),
        "median": statistics.median_low(returns),  # one of the returns, so that the dashboard can show its episode
        "least": min(returns),
        "most": max(returns),
        "success_rate": None if not success else sum(success) / len(success),
        "success_interval": None if share is None else share._asdict(),
    }


def _limits(kept: KeptEpisodes, card: JSON) -> JSON:
    """Return how an evaluation's episodes kept the limits of the specification, and whether they did so as allowed and
    as the promise in the policy's ``card`` expected."""
    said = kept.words()
    expected: JSON | None = (card.get("promise") or {}).get("fallback")
    more = expected is not None and kept.found(expected["low"], expected["high"]) == "more often"
    if expected is not None and more:
        said += f"; {kept.expected(expected['low'], expected['high'])}"
    counts = {name: getattr(kept, name) for name in ("violations", "fallbacks", "fallback_episodes")}
    return {**counts, "kept": not kept.broken and not more, "said": said}


MOST_ENTRIES = 10_000  # a zip file with more entries is not accepted as a policy
ENTRY = b"PK\x01\x02"  # first bytes of each entry in the directory of a zip file
STABLE_BASELINES = {"data", "policy.pth"}  # names of entries that a file of Stable-Baselines3 has


def check_file(form: str, content: bytes, size: int, digest: str) -> None:
    """Check the content of a policy's file.

    Args:
        form: format of the file, a key of ``FORMS``.
        content: the file.
        size: size in bytes that the sender announced.
        digest: SHA-256 hash, as hex, that the sender announced.

    Raises:
        InvalidInput: the size or hash differs, or the content does not look like this format.
    """
    if len(content) != size:
        raise InvalidInput(f"expected a file of {size} bytes, as announced, got {len(content)}: send the whole file")
    found = hashlib.sha256(content).hexdigest()
    if found != digest:
        raise InvalidInput(f"expected a file with SHA-256 {digest}, as announced, got {found}: send the file again")
    expected, looks_right = FORMS[form]
    if not looks_right(content):
        raise InvalidInput(
            f"expected {expected} for the format {form!r}, got content that begins with {content[:8]!r}: send a file "
            "of this format"
        )


def _names(content: bytes) -> set[str]:
    """Return the names of a zip file's entries; empty if the content is no zip file or has too many entries.

    The entries are counted first, because a parsed entry takes ten times its size in the file.
    """
    if content.count(ENTRY) > MOST_ENTRIES:
        return set()
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, NotImplementedError, ValueError):
        return set()
    return set(names)


def _is_policy(content: bytes) -> bool:
    names = _names(content)
    return not names.isdisjoint({network.HEAD, PLANNER_HEAD}) or names >= STABLE_BASELINES


FORMS: dict[str, tuple[str, Callable[[bytes], bool]]] = {
    "zip": (
        f"a zip of Stable-Baselines3, of a network of arrays ({network.HEAD}), or of a planner ({PLANNER_HEAD})",
        _is_policy,
    ),
    "onnx": ("a model in ONNX", lambda content: content[:1] == b"\x08"),  # begins with the field of the format version
    "pt2": ("a program of torch.export", lambda content: bool(_names(content))),
    "mp4": ("an MP4 video", lambda content: content[4:8] == b"ftyp"),
    "gif": ("a GIF", lambda content: content[:6] in (b"GIF87a", b"GIF89a")),
}
