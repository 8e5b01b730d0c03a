"""Policies: versions that are never used again, files with a bound, aliases that keep, blobs that a crash leaves."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from surrogym_server.errors import Damaged, InvalidInput, TooLarge, UnknownPolicy, UnknownSurrogate
from surrogym_server.storage.policies import NewEvaluation, PolicyFile
from surrogym_server.storage.port import Storage
from surrogym_server.storage.sql import open_storage

Make = Callable[..., str]
CARD = {"algorithm": "PPO"}
PLENTY = 10**9


def file_of(content: bytes, form: str = "zip", blob: str | None = None) -> PolicyFile:
    return PolicyFile(form, len(content), hashlib.sha256(content).hexdigest(), blob)


def pushed(storage: Storage, name: str, content: bytes, most: int = PLENTY) -> tuple[int, tuple[str, ...]]:
    """A policy with its file; its version, and the blobs that nothing leads to any more."""
    version, _, _ = storage.policies.add(name, CARD, [], file_of(content))
    freed = storage.policies.attach(name, version, file_of(content, blob=storage.blobs.put(content)), most)
    return version, freed


def evaluated(storage: Storage, name: str, version: int, key: str, content: bytes = b"{}", most: int = PLENTY) -> bool:
    new = NewEvaluation(key, {"mean": -1.5}, len(content), "digest", storage.blobs.put(content))
    return storage.policies.evaluate(name, version, new, most)[1]


def test_a_policy_comes_back_with_card_curve_and_file(storage: Storage, make: Make) -> None:
    name = make()
    version, created, _ = storage.policies.add(name, CARD, [{"steps": 1}], file_of(b"one"))
    assert (version, created) == (1, True)
    announced = storage.policies.get(name, "latest").files
    assert [(file.blob, file.main) for file in announced] == [(None, True)]
    storage.policies.attach(name, 1, file_of(b"one", blob=storage.blobs.put(b"one")), PLENTY)
    found = storage.policies.get(name, "1")
    assert (found.card, found.curve) == (CARD, [{"steps": 1}])
    (stored,) = found.files
    assert stored.blob is not None
    assert storage.blobs.get(stored.blob) == b"one"
    assert storage.policies.blobs() == {stored.blob}


def test_a_stored_version_never_changes(storage: Storage, make: Make) -> None:
    name = make()
    pushed(storage, name, b"one")
    storage.policies.put_alias(name, "production", 1)
    before = storage.policies.get(name, "production")
    again = storage.policies.add(name, {**CARD, "pushed_by": "another"}, [], file_of(b"one"))
    assert again == (1, False, ())
    other = storage.policies.add(name, {"algorithm": "SAC"}, [], file_of(b"one"))
    assert other == (2, True, ())
    assert storage.policies.add(name, {"algorithm": "SAC"}, [], file_of(b"one")) == (2, False, ())
    blob = storage.blobs.put(b"another")
    with pytest.raises(InvalidInput, match="never replaced"):
        storage.policies.attach(name, 1, file_of(b"another", blob=blob), PLENTY)
    assert storage.policies.get(name, "production") == before


def test_a_version_is_never_used_again(storage: Storage, make: Make) -> None:
    name = make()
    for content in (b"one", b"two"):
        pushed(storage, name, content)
    (freed,) = storage.policies.delete(name, 2)
    storage.blobs.remove((freed,))
    with pytest.raises(Damaged):
        storage.blobs.get(freed)
    assert pushed(storage, name, b"three")[0] == 3
    assert [policy.version for policy in storage.policies.list(name)] == [3, 1]


def test_an_alias_leads_to_one_version_and_goes_with_it(storage: Storage, make: Make) -> None:
    name = make()
    for content in (b"one", b"two"):
        pushed(storage, name, content)
    storage.policies.put_alias(name, "production", 1)
    storage.policies.put_alias(name, "production", 2)
    assert storage.policies.get(name, "production").version == 2
    assert [policy.aliases for policy in storage.policies.list(name)] == [("production",), ()]
    storage.policies.delete(name, 2)
    for which in ("production", "2", "99999999999", "²"):
        with pytest.raises(UnknownPolicy, match="which does not exist"):
            storage.policies.get(name, which)
    with pytest.raises(UnknownPolicy):
        storage.policies.put_alias(name, "production", 2)


def test_an_evaluation_is_stored_once_a_key_and_the_oldest_goes(
    storage: Storage, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = make()
    version, _ = pushed(storage, name, b"one")
    assert evaluated(storage, name, version, "a")
    assert not evaluated(storage, name, version, "a")
    monkeypatch.setattr("surrogym_server.storage.sql.policies.MAX_EVALUATIONS", 2)
    for key in ("b", "c"):
        evaluated(storage, name, version, key)
    (policy,) = storage.policies.list(name)
    assert len(policy.evaluations) == 2
    assert policy.evaluations[0].summary == {"mean": -1.5}


def test_beyond_the_bound_the_oldest_files_without_an_alias_go(storage: Storage, make: Make) -> None:
    name = make()
    versions = [pushed(storage, name, bytes([number]) * 100, most=350)[0] for number in range(3)]
    storage.policies.put_alias(name, "production", versions[0])
    evaluated(storage, name, versions[1], "a", b"x" * 40, most=350)
    _, freed = pushed(storage, name, b"new" * 33, most=350)
    assert len(freed) == 2  # the second version's file and episodes
    there = {p.version: [file.blob is not None for file in p.files] for p in storage.policies.list(name)}
    assert there == {1: [True], 2: [False], 3: [True], 4: [True]}
    assert storage.policies.get(name, "2").evaluations[0].summary == {"mean": -1.5}  # what describes it stays


def test_a_file_that_aliased_ones_leave_no_room_for_changes_nothing(storage: Storage, make: Make) -> None:
    name = make()
    version, _ = pushed(storage, name, b"x" * 100)
    storage.policies.put_alias(name, "production", version)
    with pytest.raises(TooLarge, match="150 more: delete a policy"):
        pushed(storage, name, b"y" * 150, most=100)
    assert storage.policies.get(name, "production").files[0].blob is not None


def test_beyond_the_count_the_oldest_without_an_alias_goes(
    storage: Storage, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("surrogym_server.storage.sql.policies.MAX_POLICIES", 2)
    name = make()
    for content in (b"one", b"two"):
        pushed(storage, name, content)
    storage.policies.put_alias(name, "production", 1)
    pushed(storage, name, b"three")
    assert [policy.version for policy in storage.policies.list(name)] == [3, 1]
    storage.policies.put_alias(name, "spare", 3)
    with pytest.raises(TooLarge, match="all have aliases"):
        pushed(storage, name, b"four")


def test_files_of_a_deleted_surrogate_are_orphans(storage: Storage, make: Make) -> None:
    name = make()
    version, _ = pushed(storage, name, b"one")
    evaluated(storage, name, version, "a")
    kept = storage.policies.blobs()
    assert len(kept) == 2
    storage.surrogates.delete(name)
    assert storage.policies.blobs() == set()
    assert storage.blobs.older(-60) == kept
    assert storage.blobs.older(60) == set()
    storage.blobs.remove(tuple(kept))
    storage.blobs.remove(tuple(kept))  # what is gone is no error
    assert storage.blobs.older(-60) == set()
    with pytest.raises(UnknownSurrogate):
        storage.policies.list(name)


def test_blobs_of_a_sqlite_file_lie_beside_it_for_its_owner_alone(tmp_path: Path) -> None:
    storage = open_storage(f"sqlite:///{tmp_path}/own.db")
    before = (tmp_path / "own.db").stat().st_size
    names = [storage.blobs.put(os.urandom(2**20)) for _ in range(4)]
    storage.close()
    assert (tmp_path / "own.db").stat().st_size == before  # a backup of the database stays small
    files = sorted((tmp_path / "own.db.files").iterdir())
    assert [file.name for file in files] == sorted(names)
    assert {file.stat().st_mode & 0o777 for file in files} == {0o600}


def test_a_name_that_leads_out_of_the_folder_is_damage(tmp_path: Path) -> None:
    storage = open_storage(f"sqlite:///{tmp_path}/own.db")
    (tmp_path / "secret").write_text("a secret")
    with pytest.raises(Damaged, match="name of a blob"):
        storage.blobs.get("../secret")
    storage.close()
