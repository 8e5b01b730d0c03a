"""The entry points of this checkout, as an installation of it would have them: that in use may be older."""

from __future__ import annotations

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def metadata_into(folder: Path) -> Path:
    """Write the package's metadata into a folder of the search path, and give the folder back."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    groups = {"console_scripts": project["scripts"], **project["entry-points"]}
    points = "".join(
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in members.items())
        for group, members in groups.items()
    )
    written = folder / f"surrogym-{project['version']}.dist-info"
    written.mkdir(parents=True)
    (written / "METADATA").write_text(f"Metadata-Version: 2.1\nName: surrogym\nVersion: {project['version']}\n")
    (written / "entry_points.txt").write_text(points)
    return folder
