"""A feature of the server is deleted by deleting its folder, its tests and what names it in ``app.py``."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from shutil import copytree, rmtree

import pytest

import surrogym_server

ROOT = Path(__file__).parents[2]
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
]  # it compiles steps anew


@pytest.mark.timeout(3_600)
@pytest.mark.parametrize("feature", sorted(FEATURES))
def test_what_remains_without_a_feature_passes_its_tests(feature: str, tmp_path: Path):
    packages = ("client", "server", "shared")
    for folder in (*packages, "tests"):
        copytree(ROOT / folder, tmp_path / folder, symlinks=True)
    (tmp_path / "pyproject.toml").write_text((ROOT / "pyproject.toml").read_text())
    for tree in ("server/surrogym_server", "tests/server"):
        rmtree(tmp_path / tree / "features" / feature)
    app = tmp_path / "server/surrogym_server/app.py"
    named = re.compile(rf"features\.{feature}\b|^    (\"{feature}\": )?{feature},$")
    lines = app.read_text().splitlines(keepends=True)
    kept = [line for line in lines if not named.search(line)]
    assert len(kept) == len(lines) - 2, "its import and its line"
    app.write_text("".join(kept))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(str(tmp_path / package) for package in packages)}
    ran = subprocess.run([*RUN, *REMAINING], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout[-5_000:]
