"""What other tests write in no time is what pip installs of an example package."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import PathDistribution
from pathlib import Path

import pytest

from support.searched import write_package

EXAMPLES = sorted((Path(__file__).parents[2] / "examples" / "plugins").iterdir())


def modules_and_entry_points(folder: Path) -> tuple[dict[str, bytes], set[tuple[str, str, str]]]:
    (info,) = folder.glob("*.dist-info")
    points = {(point.group, point.name, point.value) for point in PathDistribution(info).entry_points}
    return {path.name: path.read_bytes() for path in folder.glob("*.py")}, points


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.name)
def test_an_example_plugin_package_can_be_installed_with_pip(tmp_path: Path, example: Path):
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--disable-pip-version-check", "--no-compile"]
    command = [sys.executable, "-m", "pip", "install", *options, "--target", str(tmp_path / "pip"), str(example)]
    subprocess.run(command, check=True, capture_output=True)
    (tmp_path / "written").mkdir()
    write_package(example, tmp_path / "written")
    installed = modules_and_entry_points(tmp_path / "pip")
    assert installed == modules_and_entry_points(tmp_path / "written")
    assert all(installed)
