"""Where a process of a test looks for packages."""

from __future__ import annotations

import shutil
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from surrogym_server.models.registry import MODELS
from surrogym_server.sampling.acquisition import ACQUISITIONS


def with_path(folder: Path) -> str:
    """This process's own search path too: the tests may run from a checkout."""
    return ":".join([str(folder), *(path for path in sys.path if path.endswith(("server", "client", "shared")))])


def write_package(source: Path, folder: Path) -> None:
    """What pip leaves in ``folder`` of a package of single modules: these, and the entry points, in no time."""
    project = tomllib.loads((source / "pyproject.toml").read_text())["project"]
    for module in source.glob("*.py"):
        shutil.copy(module, folder)
    info = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    groups = [
        "\n".join([f"[{group}]", *(f"{name} = {value}" for name, value in entries.items())])
        for group, entries in project["entry-points"].items()
    ]
    (info / "entry_points.txt").write_text("\n".join(groups))


@contextmanager
def searching(folder: Path) -> Iterator[None]:
    """The server's registries of this process find the packages of a folder too, and forget them again."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        for registry in (ACQUISITIONS, MODELS):
            patch.setattr(registry, "_installed", None)
            patch.setattr(registry, "_broken", {})
        yield
