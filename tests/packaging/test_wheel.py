"""The wheel holds all a user needs: six packages, migrations, the page, the marks of typed packages, the commands."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = {
    "surrogym": "client",
    "surrogym_client": "client",
    "surrogym_sampler": "client",
    "surrogym_trainer": "client",
    "surrogym_server": "server",
    "surrogym_shared": "shared",
}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> ZipFile:
    folder = tmp_path_factory.mktemp("wheel")
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--disable-pip-version-check"]
    subprocess.run([sys.executable, "-m", "pip", "wheel", *options, "--wheel-dir", folder, ROOT], check=True)
    (file,) = folder.glob("surrogym-*.whl")
    return ZipFile(file)


def test_the_wheel_contains_every_source_file_and_nothing_else(wheel: ZipFile) -> None:
    expected = {
        path.relative_to(ROOT / folder).as_posix()
        for package, folder in PACKAGES.items()
        for path in (ROOT / folder / package).rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    }
    held = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert held == expected


@pytest.mark.parametrize(
    "name",
    [
        "surrogym_server/storage/sql/migrations/versions/r0100_first_schema.py",
        "surrogym_server/dashboard/index.html",
        "surrogym_server/dashboard/uplot/LICENSE",
        *(f"{package}/py.typed" for package in PACKAGES),
    ],
)
def test_the_wheel_contains_easily_forgotten_files(wheel: ZipFile, name: str) -> None:
    assert name in wheel.namelist()


def test_the_wheel_declares_its_command_entry_points(wheel: ZipFile) -> None:
    (entry_points,) = (name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    text = wheel.read(entry_points).decode()
    assert "surrogym = surrogym.cli:main" in text
    assert "serve = surrogym_server.cli.serve:register" in text


def test_the_base_install_needs_no_torch(wheel: ZipFile) -> None:
    (metadata,) = (name for name in wheel.namelist() if name.endswith("METADATA"))
    required = [line for line in wheel.read(metadata).decode().splitlines() if line.startswith("Requires-Dist: ")]
    assert all("extra ==" in line for line in required if "torch" in line)
