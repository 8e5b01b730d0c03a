"""Policies: versions that are never used again, files with a bound, aliases that keep, blobs that a crash leaves."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from surrogym_server.errors import Damaged, InvalidInput, TooLarge, UnknownPolicy, UnknownSurrogate
from surrogym_server.features.policies.blobs import open_blobs
from surrogym_server.features.policies.records import PUSHED_BY, Blobs, NewEvaluation, PolicyFile
from surrogym_server.features.policies.store import Policies
from surrogym_server.storage.sql import Storage, open_storage

Make = Callable[..., str]
CARD = {"algorithm": "PPO"}
PLENTY = 10**9


class Stored(NamedTuple):
    policies: Policies
    blobs: Blobs


@pytest.fixture
def stored(storage: Storage, url: str) -> Stored:
    return Stored(storage.part(Policies), open_blobs(storage, url, None))


def file_of(content: bytes, form: str = "zip", blob: str | None = None) -> PolicyFile:
    return PolicyFile(form, len(content), hashlib.sha256(content).hexdigest(), blob)


def pushed(stored: Stored, name: str, content: bytes, most: int = PLENTY) -> tuple[int, tuple[str, ...]]:
    """A policy with its file; its version, and the blobs that nothing leads to any more."""
    version, _, _ = stored.policies.add(name, CARD, [], file_of(content))
    freed = stored.policies.attach(name, version, file_of(content, blob=stored.blobs.put(content)), most)
    return version, freed


EPISODES = {"mean": -1.5, "episodes": 100, "controller": "policy", "declared": False}


def evaluated(
    stored: Stored,
    name: str,
    version: int,
    key: str,
    content: bytes = b"{}",
    most: int = PLENTY,
    summary: dict[str, Any] = EPISODES,
) -> bool:
    new = NewEvaluation(key, summary, len(content), "digest", stored.blobs.put(content))
    return stored.policies.evaluate(name, version, new, most)[1]


def test_a_stored_policy_is_read_back_with_description_learning_curve_and_file(stored: Stored, make: Make) -> None:
    name = make()
    version, created, _ = stored.policies.add(name, CARD, [{"steps": 1}], file_of(b"one"))
    assert (version, created) == (1, True)
    announced = stored.policies.get(name, "latest").files
    assert [(file.blob, file.main) for file in announced] == [(None, True)]
    stored.policies.attach(name, 1, file_of(b"one", blob=stored.blobs.put(b"one")), PLENTY)
    found = stored.policies.get(name, "1")
    assert (found.card, found.curve) == (CARD, [{"steps": 1}])
    (file,) = found.files
    assert file.blob is not None
    assert stored.blobs.get(file.blob) == b"one"
    assert stored.policies.blobs() == {file.blob}


def test_a_stored_policy_version_never_changes(stored: Stored, make: Make) -> None:
    name = make()
    pushed(stored, name, b"one")
    stored.policies.put_alias(name, "production", 1)
    before = stored.policies.get(name, "production")
    again = stored.policies.add(name, {**CARD, "pushed_by": "another"}, [], file_of(b"one"))
    assert again == (1, False, ())
    other = stored.policies.add(name, {"algorithm": "SAC"}, [], file_of(b"one"))
    assert other == (2, True, ())
    assert stored.policies.add(name, {"algorithm": "SAC"}, [], file_of(b"one")) == (2, False, ())
    blob = stored.blobs.put(b"another")
    with pytest.raises(InvalidInput, match="never replaced"):
        stored.policies.attach(name, 1, file_of(b"another", blob=blob), PLENTY)
    assert stored.policies.get(name, "production") == before


def test_the_number_of_a_deleted_policy_version_is_not_reused(stored: Stored, make: Make) -> None:
    name = make()
    for content in (b"one", b"two"):
        pushed(stored, name, content)
    (freed,) = stored.policies.delete(name, 2)
    stored.blobs.remove((freed,))
    with pytest.raises(Damaged):
        stored.blobs.get(freed)
    assert pushed(stored, name, b"three")[0] == 3
    assert [policy.version for policy in stored.policies.list(name)] == [3, 1]


def test_a_policy_alias_points_to_one_version_and_is_deleted_with_it(stored: Stored, make: Make) -> None:
    name = make()
    for content in (b"one", b"two"):
        pushed(stored, name, content)
    stored.policies.put_alias(name, "production", 1)
    stored.policies.put_alias(name, "production", 2)
    assert stored.policies.get(name, "production").version == 2
    assert [policy.aliases for policy in stored.policies.list(name)] == [("production",), ()]
    stored.policies.delete(name, 2)
    for which in ("production", "2", "99999999999", "²"):
        with pytest.raises(UnknownPolicy, match="which does not exist"):
            stored.policies.get(name, which)
    with pytest.raises(UnknownPolicy):
        stored.policies.put_alias(name, "production", 2)


def test_an_evaluation_is_stored_once_per_idempotency_key_and_the_oldest_is_dropped(
    stored: Stored, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = make()
    version, _ = pushed(stored, name, b"one")
    assert evaluated(stored, name, version, "a")
    assert not evaluated(stored, name, version, "a")
    monkeypatch.setattr("surrogym_server.features.policies.store.MAX_EVALUATIONS", 2)
    for key in ("b", "c"):
        evaluated(stored, name, version, key)
    (policy,) = stored.policies.list(name)
    assert len(policy.evaluations) == 2
    assert policy.evaluations[0].summary == EPISODES


@pytest.mark.parametrize("flood", [EPISODES, EPISODES | {"declared": True, "own": False}])
def test_many_other_evaluations_never_displace_one_that_decides_trust(
    stored: Stored, make: Make, monkeypatch: pytest.MonkeyPatch, flood: dict[str, Any]
) -> None:
    """A hundred of another plant removed a broken promise and a drift, and the policy was trusted again."""
    name = make()
    version, _ = pushed(stored, name, b"one")
    broken, drift = EPISODES | {"mean": -900, "declared": True, "own": True}, {"drift": {}}
    evaluated(stored, name, version, "broken", summary=broken)
    evaluated(stored, name, version, "drift", summary=drift)
    monkeypatch.setattr("surrogym_server.features.policies.store.MAX_EVALUATIONS", 5)
    for key in range(9):
        evaluated(stored, name, version, str(key), summary=flood)
    (policy,) = stored.policies.list(name)
    assert [one.summary for one in policy.evaluations] == [broken, flood, flood, flood]
    assert [one.summary for one in policy.drifts] == [drift]


def test_many_evaluations_of_one_sender_do_not_displace_those_of_others(
    stored: Stored, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hundred kept promises of one token removed the broken one that another had found."""
    name = make()
    version, _ = pushed(stored, name, b"one")
    judging = EPISODES | {"declared": True, "own": True}
    broken, kept = judging | {"mean": -900, PUSHED_BY: "train a"}, judging | {PUSHED_BY: "train b"}
    evaluated(stored, name, version, "broken", summary=broken)
    monkeypatch.setattr("surrogym_server.features.policies.store.MAX_EVALUATIONS", 5)
    for key in range(9):
        evaluated(stored, name, version, str(key), summary=kept)
    (policy,) = stored.policies.list(name)
    assert [one.summary for one in policy.evaluations] == [broken, kept, kept, kept, kept]


def test_beyond_the_size_limit_the_oldest_policy_files_without_alias_are_deleted(stored: Stored, make: Make) -> None:
    name = make()
    versions = [pushed(stored, name, bytes([number]) * 100, most=350)[0] for number in range(3)]
    stored.policies.put_alias(name, "production", versions[0])
    evaluated(stored, name, versions[1], "a", b"x" * 40, most=350)
    _, freed = pushed(stored, name, b"new" * 33, most=350)
    assert len(freed) == 2  # the second version's file and episodes
    there = {p.version: [file.blob is not None for file in p.files] for p in stored.policies.list(name)}
    assert there == {1: [True], 2: [False], 3: [True], 4: [True]}
    assert stored.policies.get(name, "2").evaluations[0].summary == EPISODES  # what describes it stays


def test_a_policy_file_is_refused_if_aliased_policies_fill_the_size_limit(stored: Stored, make: Make) -> None:
    name = make()
    version, _ = pushed(stored, name, b"x" * 100)
    stored.policies.put_alias(name, "production", version)
    with pytest.raises(TooLarge, match="150 more: delete a policy"):
        pushed(stored, name, b"y" * 150, most=100)
    assert stored.policies.get(name, "production").files[0].blob is not None


def test_beyond_the_policy_count_limit_the_oldest_without_alias_is_deleted(
    stored: Stored, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("surrogym_server.features.policies.store.MAX_POLICIES", 2)
    name = make()
    for content in (b"one", b"two"):
        pushed(stored, name, content)
    stored.policies.put_alias(name, "production", 1)
    pushed(stored, name, b"three")
    assert [policy.version for policy in stored.policies.list(name)] == [3, 1]
    stored.policies.put_alias(name, "spare", 3)
    with pytest.raises(TooLarge, match="all have aliases"):
        pushed(stored, name, b"four")


def test_many_policies_of_one_sender_do_not_displace_those_of_others(
    stored: Stored, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("surrogym_server.features.policies.store.MAX_POLICIES", 4)
    name = make()
    for number in range(2):
        stored.policies.add(name, CARD | {PUSHED_BY: "honest"}, [], file_of(b"%d" % number))
    for number in range(20):
        stored.policies.add(name, CARD | {PUSHED_BY: "flood"}, [], file_of(b"flood %d" % number))
    assert [policy.version for policy in stored.policies.list(name)] == [22, 21, 2, 1]


def test_policy_files_of_one_sender_do_not_displace_those_of_others(stored: Stored, make: Make) -> None:
    name = make()
    for number, sender in enumerate(["honest", *["flood"] * 5]):
        content = bytes([number]) * 100
        version, _, _ = stored.policies.add(name, CARD | {PUSHED_BY: sender}, [], file_of(content))
        stored.policies.attach(name, version, file_of(content, blob=stored.blobs.put(content)), 350)
    policies = stored.policies.list(name)
    assert [policy.version for policy in policies if policy.files[0].blob is not None] == [6, 5, 1]


def test_policy_files_of_a_deleted_surrogate_become_orphaned_blobs(
    storage: Storage, stored: Stored, make: Make
) -> None:
    name = make()
    version, _ = pushed(stored, name, b"one")
    evaluated(stored, name, version, "a")
    kept = stored.policies.blobs()
    assert len(kept) == 2
    storage.surrogates.delete(name)
    assert stored.policies.blobs() == set()
    assert stored.blobs.older(-60) == kept
    assert stored.blobs.older(60) == set()
    stored.blobs.remove(tuple(kept))
    stored.blobs.remove(tuple(kept))  # what is gone is no error
    assert stored.blobs.older(-60) == set()
    with pytest.raises(UnknownSurrogate):
        stored.policies.list(name)


def test_blobs_of_a_sqlite_database_are_files_readable_by_its_owner_only(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/own.db"
    storage = open_storage(url)
    blobs = open_blobs(storage, url, None)
    before = (tmp_path / "own.db").stat().st_size
    names = [blobs.put(os.urandom(2**20)) for _ in range(4)]
    storage.close()
    assert (tmp_path / "own.db").stat().st_size == before  # a backup of the database stays small
    files = sorted((tmp_path / "own.db.files").iterdir())
    assert [file.name for file in files] == sorted(names)
    assert {file.stat().st_mode & 0o777 for file in files} == {0o600}


def test_a_blob_name_that_leaves_the_blob_folder_is_refused(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/own.db"
    storage = open_storage(url)
    blobs = open_blobs(storage, url, None)
    (tmp_path / "secret").write_text("a secret")
    with pytest.raises(Damaged, match="name of a stored file"):
        blobs.get("../secret")
    storage.close()
