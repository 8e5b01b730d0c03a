"""Services over a real SQLite file and a real model, with fits that a test decides on."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from support import pendulum
from support.remembered import learn_once
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.sampling.design import initial_queries
from surrogym_server.services.definitions import Definitions
from surrogym_server.storage.records import NewSurrogate
from surrogym_server.storage.sql import Storage, open_storage
from surrogym_shared.spec import EnvironmentSpec

NAME = "pendulum"


def define(spec: dict) -> EnvironmentDefinition:
    return definition_from_spec(EnvironmentSpec.model_validate(spec))


@pytest.fixture(autouse=True)
def _equal_fits_are_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surrogym_server.sampling.design.learn", learn_once)


@pytest.fixture
def storage(tmp_path: Path, prepared_file: Path) -> Iterator[Storage]:
    """With one surrogate whose initial queries are open."""
    shutil.copy(prepared_file, tmp_path / "surrogym.db")
    opened = open_storage(f"sqlite:///{tmp_path / 'surrogym.db'}")
    spec = pendulum.spec()
    queries = initial_queries(define(spec), pendulum.BUDGET)
    opened.surrogates.create(NewSurrogate(NAME, spec, pendulum.BUDGET, 0.999, queries))
    yield opened
    opened.close()


@pytest.fixture
def definitions(storage: Storage) -> Definitions:
    return Definitions(storage, define)


@pytest.fixture
def answered(storage: Storage) -> Storage:
    """Its initial queries are answered: a fit is due."""
    pendulum.answer_open(storage, NAME)
    return storage
