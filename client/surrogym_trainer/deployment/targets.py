"""The targets of a deployment by name, and the writing of their files to a folder."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from surrogym_trainer.deployment.c import running as running_c
from surrogym_trainer.deployment.c import write as write_c
from surrogym_trainer.deployment.c import write_arduino
from surrogym_trainer.deployment.controller import Controller, NotDeployable
from surrogym_trainer.deployment.fmu import running as running_fmu
from surrogym_trainer.deployment.fmu import write as write_fmu
from surrogym_trainer.deployment.graph import running as running_onnx
from surrogym_trainer.deployment.graph import write as write_onnx
from surrogym_trainer.deployment.running import Running
from surrogym_trainer.deployment.st import write as write_st
from surrogym_trainer.policies.controller_check import FILE


@dataclass(frozen=True)
class Target:
    """A form in which a controller can be written.

    Attributes:
        write: writes the files of a controller into an empty folder.
        running: runs the controller as the target does; None if nothing on this machine can.
    """

    write: Callable[[Controller, Path], None]
    running: Callable[[Controller], AbstractContextManager[Running]] | None = None


TARGETS = {
    "c": Target(write_c, running_c),
    "arduino": Target(write_arduino, partial(running_c, single=True)),
    "fmu": Target(write_fmu, running_fmu),
    "onnx": Target(write_onnx, running_onnx),
    "st": Target(write_st),
}


def target_of(name: str) -> Target:
    """Return the target with this name. Raises ``NotDeployable`` if there is none."""
    if name not in TARGETS:
        raise NotDeployable(f"expected one of the targets {', '.join(TARGETS)}, got {name!r}")
    return TARGETS[name]


def deploy(controller: Controller, target: str, out: Path) -> list[Path]:
    """Write a controller's files for a target to a folder, and return their paths.

    A folder that already contains exactly these files, with or without the record of a check, stays as it is. A folder
    with other files is refused.

    Raises:
        NotDeployable: the target is unknown, it can't express the controller, or the folder has other files.
        CannotCompile: the C compiler refused the sources of an FMU.
    """
    with TemporaryDirectory() as made:
        target_of(target).write(controller, Path(made))
        names = sorted(path.relative_to(made) for path in Path(made).rglob("*") if path.is_file())
        if other := _other(out, Path(made), names):
            raise NotDeployable(
                f"expected a new or an empty folder, got {out} with {other}: nothing was written; choose another "
                "folder, or empty this one"
            )
        _copy(Path(made), out, names)
    return [out / name for name in names]


def _copy(made: Path, out: Path, names: list[Path]) -> None:
    """Copy the files ``names`` from the folder ``made`` to ``out``, unless they exist there. After an error, delete the
    copies."""
    written = []
    try:
        for name in (name for name in names if not (out / name).exists()):
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            with (out / name).open("xb") as file:
                written.append(out / name)
                file.write((made / name).read_bytes())
    except BaseException:
        for path in written:
            path.unlink(missing_ok=True)
        raise


def _other(out: Path, made: Path, names: list[Path]) -> str:
    """Return the name of a file in the folder ``out`` that is not one of the files to write; empty if there is none.
    The record of a check is accepted if all files to write exist."""
    if not out.exists():
        return ""
    if not out.is_dir():
        return "a file of this name"
    whole = all((out / name).is_file() for name in names)
    for path in sorted(out.rglob("*")):
        name = path.relative_to(out)
        if whole and str(name) == FILE:
            continue
        if path.is_file() and (name not in names or path.read_bytes() != (made / name).read_bytes()):
            return str(name)
    return ""
