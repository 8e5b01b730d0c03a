"""Write a block as an FMU: description, sources, and native code if a C compiler is at hand."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from surrogym_shared.fmu.block import Block
from surrogym_shared.fmu.description import build_description, model_description

COMPILERS = ("cc", "gcc", "clang")
FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-ffp-contract=off")
WRAPPER = "fmi3.c"
EPOCH = (1980, 1, 1, 0, 0, 0)  # so that the same block gives the same bytes
SECONDS = 600  # for a compilation
SHOWN = 2_000  # characters of a compiler's errors
SYSTEMS = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib"), "win32": ("windows", ".dll")}
MACHINES = {"amd64": "x86_64", "x86_64": "x86_64", "arm64": "aarch64", "aarch64": "aarch64"}


class CannotCompile(RuntimeError):
    """The C compiler refused the sources. The message has what it printed."""


@dataclass(frozen=True)
class WrittenFmu:
    """An FMU on disk. ``binary`` is the platform of its native code, such as ``x86_64-linux``; None without a compiler
    on this machine."""

    path: Path
    bytes: int
    binary: str | None


def write_fmu(block: Block, path: Path, compiler: str | None = None) -> WrittenFmu:
    """Write an FMU.

    Args:
        path: file to write; it replaces one of this name only when the new one is whole.
        compiler: C compiler; None: the variable ``CC``, or one of cc, gcc and clang on the search path, if there is
            one.

    Raises:
        CannotCompile: the compiler refused the sources.
        OSError: the file can't be written.
    """
    sources = dict(block.sources)
    sources[WRAPPER] = (files(__package__) / WRAPPER).read_text(encoding="utf-8")
    sources["block.h"] = block.header()
    compiled = sorted(name for name in sources if name.endswith(".c"))
    entries = {"modelDescription.xml": model_description(block)}
    entries |= {f"sources/{name}": text.encode() for name, text in sorted(sources.items())}
    entries["sources/buildDescription.xml"] = build_description(block, compiled)
    chosen = compiler or os.environ.get("CC") or next((one for one in COMPILERS if shutil.which(one)), None)
    binary = None
    if chosen is not None:
        binary, ending = here()
        library = _compiled(chosen, sources, compiled)
        entries[f"binaries/{binary}/{block.identifier}{ending}"] = library
    partial = path.with_name(path.name + ".part")
    with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(zipfile.ZipInfo(name, EPOCH), content, zipfile.ZIP_DEFLATED)
    partial.replace(path)
    return WrittenFmu(path, path.stat().st_size, binary)


def here() -> tuple[str, str]:
    """Name of this platform in FMI 3.0, and the ending of its shared libraries."""
    system, ending = SYSTEMS.get(sys.platform, (sys.platform, ".so"))
    machine = platform.machine().lower()
    return f"{MACHINES.get(machine, machine)}-{system}", ending


def _compiled(compiler: str, sources: dict[str, str], names: list[str]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        for name, text in sources.items():
            Path(folder, name).write_text(text, encoding="utf-8")
        library = Path(folder, "library")
        command = [*compiler.split(), *FLAGS, "-o", str(library), *names, "-lm"]
        try:
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=SECONDS, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise CannotCompile(f"expected a C compiler, got {compiler!r}: {error}") from error
        if done.returncode:
            raise CannotCompile(f"{compiler} refused the sources:\n{done.stderr[:SHOWN]}")
        return library.read_bytes()
