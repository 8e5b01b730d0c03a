"""A server compiles steps ahead where nothing is kept yet, and only there."""

from __future__ import annotations

from pathlib import Path

import pytest

from surrogym_server.engine import local
from surrogym_server.engine.local import Compiling
from surrogym_shared import compiled
from surrogym_shared.compiled import disk_cache

pytestmark = pytest.mark.skipif(not compiled.available(), reason="numba is not installed, or switched off")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder in the place of the user's."""
    monkeypatch.setattr(disk_cache, "folder", lambda _: tmp_path)
    return tmp_path


def test_without_a_compile_cache_the_server_compiles_in_a_separate_process(
    folder: Path, monkeypatch: pytest.MonkeyPatch
):
    done = folder / "done"
    monkeypatch.setattr(local, "PROGRAM", f"open({str(done)!r}, 'w').close()")
    ahead = Compiling()
    ahead.start()
    ahead.wait()
    assert done.exists()
    ahead.close()


def test_with_a_filled_compile_cache_the_server_starts_no_compile_process(
    folder: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(local.subprocess, "Popen", lambda *_, **__: pytest.fail("nothing is left to compile"))
    (folder / "step").mkdir()
    (folder / "step" / "step.nbi").touch()
    Compiling().start()


def test_closing_the_server_ends_its_compile_process(folder: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(local, "PROGRAM", "import time; time.sleep(600)")
    ahead = Compiling()
    ahead.start()
    ahead.close()
    assert ahead._process is not None
    assert ahead._process.poll() is not None
