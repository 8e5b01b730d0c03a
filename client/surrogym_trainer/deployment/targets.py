"""The targets of a deployment, by name, and the folder that one is written to."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from tempfile import TemporaryDirectory

from surrogym_trainer.deployment.c import running as running_c
from surrogym_trainer.deployment.c import write as write_c
from surrogym_trainer.deployment.c import write_arduino
from surrogym_trainer.deployment.controller import Controller, NotDeployable
from surrogym_trainer.deployment.fmu import write as write_fmu
from surrogym_trainer.deployment.graph import write as write_onnx
from surrogym_trainer.deployment.running import Running
from surrogym_trainer.deployment.st import write as write_st

Runner = Callable[[Controller], AbstractContextManager[Running]]
"""Run a controller as the target does, for ``surrogym deploy --check``."""

Writer = Callable[[Controller, Path], None]
"""Write the files of a controller into an empty folder."""

TARGETS: dict[str, Writer] = {
    "c": write_c,
    "arduino": write_arduino,
    "fmu": write_fmu,
    "onnx": write_onnx,
    "st": write_st,
}
RUNNERS: dict[str, Runner] = {"c": running_c, "arduino": running_c}


def deploy(controller: Controller, target: str, out: Path) -> list[Path]:
    """Write a controller's files to a folder, and return their paths.

    A folder that already has exactly these files stays as it is. Any other folder with files is left alone.

    Raises:
        NotDeployable: the target is unknown, it can't express the controller, or the folder has other files.
    """
    if target not in TARGETS:
        raise NotDeployable(f"expected the target {', '.join(TARGETS)}, got {target!r}")
    with TemporaryDirectory() as made:
        TARGETS[target](controller, Path(made))
        names = sorted(path.relative_to(made) for path in Path(made).rglob("*") if path.is_file())
        if other := _other(out, Path(made), names):
            raise NotDeployable(f"expected a new or an empty folder, got {out} with {other}: nothing was written")
        shutil.copytree(made, out, dirs_exist_ok=True)
    return [out / name for name in names]


def _other(out: Path, made: Path, names: list[Path]) -> str:
    """Return the name of a file in the folder that is not one of the files made; empty if there is none."""
    if not out.exists():
        return ""
    if not out.is_dir():
        return "a file of this name"
    for path in sorted(out.rglob("*")):
        name = path.relative_to(out)
        if path.is_file() and (name not in names or path.read_bytes() != (made / name).read_bytes()):
            return str(name)
    return ""
