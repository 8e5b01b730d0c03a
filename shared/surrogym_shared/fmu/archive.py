"""Write a block as an FMU: description, sources, and native code if a C compiler is at hand."""

from __future__ import annotations

import platform
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from surrogym_shared.c_compiler import CannotCompile, c_compiler, compile_c
from surrogym_shared.fmu.block import Block
from surrogym_shared.fmu.description import build_description, model_description

FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-ffp-contract=off")
WRAPPER = "fmi3.c"
LOADS = "import ctypes, sys; ctypes.CDLL(sys.argv[1])"  # program that tests whether this machine can load a library
EPOCH = (1980, 1, 1, 0, 0, 0)  # fixed date of all entries of the zip file, so that equal FMUs have equal bytes
SYSTEMS = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib"), "win32": ("windows", ".dll")}
MACHINES = {"amd64": "x86_64", "x86_64": "x86_64", "arm64": "aarch64", "aarch64": "aarch64"}


@dataclass(frozen=True)
class WrittenFmu:
    """An FMU on disk. ``binary`` is the platform of its native code, such as ``x86_64-linux``; None without a compiler
    on this machine."""

    path: Path
    bytes: int
    binary: str | None


def write_fmu(block: Block, path: Path) -> WrittenFmu:
    """Write an FMU, with native code if this machine has a C compiler.

    Args:
        block: content of the FMU.
        path: file to write. An existing file is replaced only after the new one is complete.

    Raises:
        CannotCompile: the compiler refused the sources, or the variable ``CC`` names no compiler.
        OSError: the file can't be written.
    """
    sources = dict(block.sources)
    sources[WRAPPER] = (files(__package__) / WRAPPER).read_text(encoding="utf-8")
    sources["block.h"] = block.header()
    compiled = sorted(name for name in sources if name.endswith(".c"))
    entries = {"modelDescription.xml": model_description(block)}
    entries |= {f"sources/{name}": text.encode() for name, text in sorted(sources.items())}
    entries["sources/buildDescription.xml"] = build_description(block, compiled)
    binary = None
    if (command := c_compiler()) is not None:
        binary, ending = here()
        entries[f"binaries/{binary}/{block.identifier}{ending}"] = _compiled(command, sources, compiled)
    partial = path.with_name(path.name + ".part")
    with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(zipfile.ZipInfo(name, EPOCH), content, zipfile.ZIP_DEFLATED)
    partial.replace(path)
    return WrittenFmu(path, path.stat().st_size, binary)


def here() -> tuple[str, str]:
    """Return the name of this platform in FMI 3.0, such as ``x86_64-linux``, and the suffix of its shared libraries."""
    system, ending = SYSTEMS.get(sys.platform, (sys.platform, ".so"))
    machine = platform.machine().lower()
    return f"{MACHINES.get(machine, machine)}-{system}", ending


def _compiled(command: tuple[str, ...], sources: dict[str, str], names: list[str]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        for name, text in sources.items():
            Path(folder, name).write_text(text, encoding="utf-8")
        library = Path(folder, "library")
        compile_c(command, FLAGS, names, library, Path(folder))
        if subprocess.run([sys.executable, "-c", LOADS, str(library)], capture_output=True, check=False).returncode:
            raise CannotCompile(
                f"expected a C compiler for this machine, got {command[0]}, whose library can't be loaded: set the "
                "variable CC to another compiler"
            )
        return library.read_bytes()
