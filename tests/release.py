"""Check the wheel and the source distribution of a folder: ``make release`` builds them first. Nothing is published.

Usage: python tests/release.py dist

Each is installed with its dependencies into an environment of its own, where the thin client, the commands and the type
marks have to work without the repository.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import venv
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from zipfile import ZipFile

ROOT = Path(__file__).parents[1]
WORKS = """
import importlib.metadata, importlib.resources, importlib.util, sys
import gymnasium, surrogym, surrogym_client, surrogym_sampler, surrogym_shared, surrogym_trainer
assert importlib.metadata.version("surrogym") == sys.argv[1]
assert "surrogym/Remote-v0" in gymnasium.registry
assert importlib.util.find_spec("surrogym_lab") is None, "the laboratory was installed"
assert importlib.util.find_spec("torch") is None, "the base install brought torch"
assert importlib.resources.files(surrogym_client).joinpath("py.typed").is_file()
"""


def main(folder: Path) -> int:
    """Print one line for each check. Returns 1 if one failed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    version = project["version"]
    wheel = folder / f"surrogym-{version}-py3-none-any.whl"
    source = folder / f"surrogym-{version}.tar.gz"
    faults = [*metadata_faults(project), *content_faults(wheel, source)]
    for archive in (wheel, source):
        faults += install_faults(archive, version)
    for fault in faults:
        print(f"problem  {fault}")
    if not faults:
        print(f"ok       surrogym {version}: {wheel.name} and {source.name} install and work alone")
        print(f"to do    date the first section of CHANGELOG.md as {version}, commit, and tag the commit v{version}")
    return int(bool(faults))


def metadata_faults(project: dict[str, Any]) -> Iterator[str]:
    """What the files that name the version, or the Python that runs the tests, contradict."""
    version = project["version"]
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    if cited is None or cited[1] != version:
        yield f"CITATION.cff: expected version {version}, got {cited and cited[1]}"
    if not re.search(rf"^## (Unreleased|{re.escape(version)})\b", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE):
        yield f"CHANGELOG.md: expected a section Unreleased or {version}"
    tried = "Programming Language :: Python :: {}.{}".format(*sys.version_info[:2])
    named = {line for line in project["classifiers"] if re.search(r":: Python :: \d", line)}
    if named != {tried}:
        yield f"classifiers: expected {tried} alone, the Python that runs the tests, got {sorted(named)}"


def content_faults(wheel: Path, source: Path) -> Iterator[str]:
    """Files that an archive lacks."""
    held = ZipFile(wheel).namelist()
    if not any(name.endswith("/licenses/LICENSE") for name in held):
        yield f"{wheel.name}: expected the file LICENSE"
    with tarfile.open(source) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    wanted = {"LICENSE", "README.md", "CHANGELOG.md", "CITATION.cff", "pyproject.toml", "constraints.txt"}
    yield from (f"{source.name}: expected the file {name}" for name in sorted(wanted - names))


def install_faults(archive: Path, version: str) -> Iterator[str]:
    """What does not work after ``pip install ARCHIVE`` in an empty environment, outside of the repository."""
    with tempfile.TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        python = str(Path(folder, "bin", "python"))
        pip = [python, "-m", "pip", "install", "-qq", "--disable-pip-version-check", str(archive.resolve())]
        for command in (pip, [python, "-c", WORKS, version], [python, "-m", "surrogym", "--version"]):
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
            if done.returncode:
                yield f"{archive.name}: {' '.join(command[1:3])}: {done.stderr.strip()[-500:]}"
                return


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
