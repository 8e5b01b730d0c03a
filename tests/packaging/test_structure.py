"""Rules of the layout that no linter knows. import-linter holds the directions of imports."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import surrogym
import surrogym_client
import surrogym_sampler
import surrogym_server
import surrogym_shared
import surrogym_trainer

OURS = (surrogym, surrogym_client, surrogym_sampler, surrogym_trainer, surrogym_server, surrogym_shared)
PACKAGES = [Path(str(package.__file__)).parent for package in OURS]
TESTS = Path(__file__).parents[1]
UNFINISHED = re.compile(r"\b(TODO|FIXME|XXX)\b")


def rooms(folder: Path) -> set[str]:
    """Names of the folders that hold Python files."""
    return {path.name for path in folder.iterdir() if path.is_dir() and any(path.rglob("*.py"))}


def sources() -> Iterator[Path]:
    yield from (path for package in PACKAGES for path in package.rglob("*.py"))


def test_server_test_folders_mirror_the_server_packages():
    """A reader finds the tests of a room under the room's name, and no tests stay behind when a room goes."""
    assert rooms(TESTS / "server") <= rooms(Path(str(surrogym_server.__file__)).parent)


def test_no_source_file_contains_a_todo_mark():
    assert [str(path) for path in sources() if UNFINISHED.search(path.read_text(encoding="utf-8"))] == []
