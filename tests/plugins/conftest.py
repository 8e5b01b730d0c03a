"""A server beside which the example packages are installed, and one package for each group that is broken."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from support.searched import with_path, write_package
from support.server import ServerProcess, running_server

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples" / "plugins").iterdir())


@pytest.fixture(scope="session")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the example packages, and packages that are broken."""
    folder = tmp_path_factory.mktemp("site")
    for example in EXAMPLES:
        write_package(example, folder)
    for kind in ("acquisition", "model"):
        broken = folder / f"broken_{kind}-1.0.dist-info"
        broken.mkdir()
        (broken / "METADATA").write_text(f"Metadata-Version: 2.1\nName: broken_{kind}\nVersion: 1.0\n")
        (broken / "entry_points.txt").write_text(f"[surrogym.{kind}s]\nbroken = nowhere_to_be_found:Missing\n")
    return folder


@pytest.fixture(scope="session")
def plugin_server(installed: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    with running_server(tmp_path_factory.mktemp("server"), PYTHONPATH=with_path(installed)) as server:
        yield server
