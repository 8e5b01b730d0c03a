"""A release is refused if its files disagree about the version, claim an untried Python, or lack a file."""

from __future__ import annotations

import tarfile
import tomllib
from pathlib import Path
from zipfile import ZipFile

from release import content_faults, metadata_faults

ROOT = Path(__file__).parents[2]


def project() -> dict[str, object]:
    found: dict[str, object] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return found


def test_the_release_files_agree_about_version_and_supported_pythons() -> None:
    assert list(metadata_faults(project())) == []


def test_the_release_check_finds_a_wrong_version_and_an_untested_python() -> None:
    faults = list(
        metadata_faults(project() | {"version": "9.9.9", "classifiers": ["Programming Language :: Python :: 3.99"]})
    )
    assert [fault.partition(":")[0] for fault in faults] == ["CITATION.cff", "classifiers"]


def test_the_release_check_finds_archives_without_licence(tmp_path: Path) -> None:
    wheel, source = tmp_path / "a.whl", tmp_path / "a.tar.gz"
    ZipFile(wheel, "w").writestr("surrogym/__init__.py", "")
    with tarfile.open(source, "w:gz") as archive:
        for name in ("README.md", "CHANGELOG.md", "CITATION.cff", "pyproject.toml", "constraints.txt"):
            archive.add(ROOT / name, f"surrogym-0/{name}")
    assert list(content_faults(wheel, source)) == [
        "a.whl: expected the file LICENSE",
        "a.tar.gz: expected the file LICENSE",
    ]
