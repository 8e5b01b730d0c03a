"""A file of a policy is never lost to a connection that broke at the wrong moment."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from support import pendulum
from surrogym_server.errors import Forbidden, TooLarge, Unavailable
from surrogym_server.features.policies.blobs import RowBlobs
from surrogym_server.features.policies.records import PolicyFile
from surrogym_server.features.policies.service import PolicyService
from surrogym_server.features.policies.store import Policies
from surrogym_server.services.notices import Notices
from surrogym_server.storage.records import NewSurrogate
from surrogym_server.storage.sql import Storage, open_storage
from surrogym_shared.wire import AddEvaluation

NAME = "pendulum"
GIF = b"GIF89a and so on"
EPISODES = AddEvaluation(first_seed=0, returns=[-1.0], lengths=[3], idempotency_key="key")


@pytest.fixture
def storage(tmp_path: Path) -> Iterator[Storage]:
    """With one surrogate."""
    opened = open_storage(f"sqlite:///{tmp_path / 'surrogym.db'}")
    opened.surrogates.create(NewSurrogate(NAME, pendulum.spec(), pendulum.BUDGET, 0.999))
    yield opened
    opened.close()


class Silent(Notices):
    """Notices without an event loop."""

    def __init__(self) -> None: ...

    def post(self, surrogate: str) -> None: ...


def service(storage: Storage, most: int = 10_000) -> tuple[PolicyService, PolicyFile]:
    """With a policy whose file is to come."""
    file = PolicyFile("gif", len(GIF), hashlib.sha256(GIF).hexdigest())
    policies = PolicyService(storage, storage.part(RowBlobs), lambda spec: spec, Silent(), most)
    policies.add(NAME, {"spec": None}, [], file, by="train one")
    return policies, file


def lost_at_commit(monkeypatch: pytest.MonkeyPatch, operation: str) -> None:
    """Let an operation be carried out, and its caller not hear of it."""
    carry_out = getattr(Policies, operation)

    def broken(*arguments: Any) -> None:
        carry_out(*arguments)
        raise Unavailable("the connection was lost")

    monkeypatch.setattr(Policies, operation, broken)


def test_a_policy_file_is_stored_although_its_commit_acknowledgement_was_lost(
    storage: Storage, monkeypatch: pytest.MonkeyPatch
):
    policies, file = service(storage)
    with monkeypatch.context() as patched:
        lost_at_commit(patched, "attach")
        with pytest.raises(Unavailable, match="connection was lost"):
            policies.put_file(NAME, 1, file, GIF)
    assert policies.file(NAME, "1", "gif") == (1, GIF)


def test_an_evaluation_whose_commit_acknowledgement_was_lost_is_stored_once(
    storage: Storage, monkeypatch: pytest.MonkeyPatch
):
    policies, _ = service(storage)
    with monkeypatch.context() as patched:
        lost_at_commit(patched, "evaluate")
        with pytest.raises(Unavailable, match="connection was lost"):
            policies.evaluate(NAME, 1, EPISODES, "anybody")
    _, stored = policies.evaluate(NAME, 1, EPISODES, "anybody")
    assert policies.episodes(NAME, "1", stored.id)[2:] == (
        {"returns": [-1.0], "lengths": [3], "success": None, "traces": []},
        None,
    )


def test_a_refused_policy_file_leaves_no_stored_blob(storage: Storage):
    policies, file = service(storage, most=len(GIF) - 1)
    with pytest.raises(TooLarge):
        policies.put_file(NAME, 1, file, GIF)
    assert storage.part(RowBlobs).older(-1.0) == set()


def test_only_the_sender_of_a_policy_version_can_add_files_to_it(storage: Storage):
    policies, file = service(storage)
    with pytest.raises(Forbidden, match="train one"):
        policies.put_file(NAME, 1, file, GIF, by="train two")
    assert [one.blob for one in policies.get(NAME, "1").files] == [None]
    policies.put_file(NAME, 1, file, GIF, by="train one")
    policies.put_file(NAME, 1, file, GIF)
    assert policies.file(NAME, "1", "gif") == (1, GIF)
