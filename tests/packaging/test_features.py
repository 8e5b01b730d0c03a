"""A feature of the server is deleted by deleting its folder, its tests and what names it in ``app.py``."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from hashlib import sha1
from pathlib import Path
from shutil import copytree, move, rmtree

import pytest

import surrogym_server
from surrogym_shared.compiled import disk_cache

ROOT = Path(__file__).parents[2]
PACKAGES = ("client", "server", "shared")
APP = "server/surrogym_server/app.py"
FOLDERS = Path(str(surrogym_server.__file__)).parent / "features"
FEATURES = [path.name for path in FOLDERS.iterdir() if (path / "__init__.py").exists()]
REMAINING = [
    f"tests/{room}" for room in ("server/api", "server/services", "server/storage", "server/features", "contract")
]
RUN = [
    sys.executable,
    "-m",
    "pytest",
    "-q",
    "-x",
    "-p",
    "no:cacheprovider",
    "-o",
    "timeout=1200",
]  # where nothing is compiled yet, it compiles steps


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A copy of the checkout, and of what it has compiled."""
    made = tmp_path_factory.mktemp("features") / "checkout"
    for folder in (*PACKAGES, "tests", "examples", "docker"):
        copytree(ROOT / folder, made / folder, symlinks=True)
    (made / "pyproject.toml").write_text((ROOT / "pyproject.toml").read_text())
    copies = [(kept_of(path), kept_of(made / path.relative_to(ROOT))) for path in sources()]
    for here, there in copies:
        if here.exists():
            copytree(here, there)
    yield made
    for _, there in copies:
        rmtree(there, ignore_errors=True)


def sources() -> set[Path]:
    return {path.parent for package in PACKAGES for path in (ROOT / package).rglob("*.py")}


def kept_of(folder: Path) -> Path:
    """Where numba keeps what it compiled from the sources in a folder; their content is the same in a copy."""
    whole = disk_cache.folder("surrogym_server")
    assert whole is not None
    return whole / f"{folder.name}_{sha1(str(folder).encode()).hexdigest()}"


@pytest.fixture
def without(checkout: Path, tmp_path: Path) -> Iterator[Callable[[str], None]]:
    """Deletes a feature from the copy, until the test has ended."""
    app = checkout / APP
    lines, moved = app.read_text().splitlines(keepends=True), []

    def delete(feature: str) -> None:
        named = re.compile(rf"features\.{feature}\b|^    (\"{feature}\": )?{feature},$")
        kept = [line for line in lines if not named.search(line)]
        assert len(kept) == len(lines) - 2, "its import and its line"
        app.write_text("".join(kept))
        for tree in ("server/surrogym_server", "tests/server"):
            folder = checkout / tree / "features" / feature
            moved.append((folder, move(folder, tmp_path / tree.replace("/", "-"))))

    yield delete
    app.write_text("".join(lines))
    for folder, place in moved:
        move(place, folder)


@pytest.mark.timeout(3_600)
@pytest.mark.parametrize("feature", sorted(FEATURES))
def test_the_remaining_tests_pass_after_deleting_an_optional_server_feature(
    feature: str, checkout: Path, without: Callable[[str], None]
) -> None:
    without(feature)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(str(checkout / package) for package in PACKAGES)}
    ran = subprocess.run([*RUN, *REMAINING], cwd=checkout, env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout[-5_000:]
