"""FMUs of FMI 3.0 for co-simulation, written around C99 source that steps at a fixed period.

A block is the content of an FMU: its variables, its period, and the C source of its step. It is written with the XML
files of an FMU, the sources, and native code if a C compiler is at hand.
"""

from __future__ import annotations

import hashlib
import json
import platform
import re
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Literal, get_args
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from surrogym_shared.c_compiler import CannotCompile, c_compiler, compile_c
from surrogym_shared.checks import require, require_unique

Kind = Literal["Float64", "Int32", "Boolean"]
Causality = Literal["input", "output", "parameter"]
KINDS: tuple[Kind, ...] = get_args(Kind)
NEVER, AT_START, ALWAYS = range(3)  # when a simulator may set a variable: never, before the simulation, always
TIME = "time"  # name of the independent variable, which every FMU has


@dataclass(frozen=True)
class Variable:
    """One variable of an FMU.

    Attributes:
        start: value at the start of a simulation; None for an output that ``block_start`` calculates.
        unit: unit of the value; empty if it is unknown.
    """

    name: str
    kind: Kind
    causality: Causality
    start: float | None = None
    low: float | None = None
    high: float | None = None
    unit: str = ""
    description: str = ""

    @property
    def settable(self) -> int:
        if self.causality == "input":
            return ALWAYS
        return NEVER if self.start is None else AT_START


@dataclass(frozen=True)
class Block:
    """Content of an FMU: a model that steps at a fixed period, as C99 source.

    ``sources`` define the two functions of the generated file ``block.h`` (see ``header``). Both return 0, or 1 + the
    index of a variable whose value they can't use.

    - ``int block_start(double *values, double *memory)`` calculates the outputs at the start. It may be called again
      after a start value has changed.
    - ``int block_step(double *values, const double *held, double *memory)`` reads the inputs from ``held``, and
      everything else from ``values``, and writes the outputs to ``values``.

    Attributes:
        variables: all values, in the order of the arrays ``values`` and ``held``.
        period: seconds between two steps.
        stop: default end of a simulation, in seconds; None for none.
        sources: contents of C files and headers by name. Each file that ends in .c is compiled.
        memory: number of float64 numbers that a block keeps from step to step in addition to its variables.
        acts_first: whether the outputs change at the beginning of a period, as a controller's do, or at its end.

    Raises:
        ValueError: two variables have the same name, a name is ``time`` or has control characters, or the period is not
            above 0.
    """

    name: str
    description: str
    variables: tuple[Variable, ...]
    period: float
    stop: float | None
    sources: Mapping[str, str]
    memory: int = 0
    acts_first: bool = False

    def __post_init__(self) -> None:
        names = [one.name for one in self.variables]
        require_unique("variable", [TIME, *names])
        odd = [name for name in names if not name.isprintable()]
        require(not odd, f"expected names of variables without control characters, got {odd}")
        require(self.period > 0, f"expected a period above 0 s, got {self.period}")

    @property
    def identifier(self) -> str:
        """Name of the block, as a C identifier."""
        plain = re.sub(r"\W", "_", self.name, flags=re.ASCII)
        return plain if plain[:1].isalpha() else f"fmu_{plain}"

    @property
    def token(self) -> str:
        """Text in ``modelDescription.xml`` and in the native code, which shows that both belong together. Only equal
        blocks have equal tokens."""
        parts = [self.name, self.description, repr(self.variables), repr((self.period, self.memory, self.acts_first))]
        parts += [part for name in sorted(self.sources) for part in (name, self.sources[name])]
        return "{" + hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32] + "}"

    def header(self) -> str:
        """Return the content of the C header ``block.h``."""
        return "\n".join(self._header())

    def _header(self) -> Iterator[str]:
        count = len(self.variables)
        yield "/* Values of the block, its two functions and its period. */"
        yield f'#define BLOCK_TOKEN "{self.token}"'
        yield f"#define BLOCK_PERIOD {self.period!r} /* s */"
        yield f"#define BLOCK_ACTS_FIRST {int(self.acts_first)}"
        yield f"#define BLOCK_VALUES {count}"
        yield f"#define BLOCK_MEMORY {max(self.memory, 1)}"
        yield "int block_start(double *values, double *memory);"
        yield "int block_step(double *values, const double *held, double *memory);"
        yield "#ifdef BLOCK_TABLES"
        yield _array("char *const", "block_names", [_string(one.name) for one in self.variables])
        yield _array("double", "block_starts", [repr(float(one.start or 0.0)) for one in self.variables])
        yield _array("unsigned char", "block_kinds", [str(KINDS.index(one.kind)) for one in self.variables])
        yield _array("unsigned char", "block_settable", [str(one.settable) for one in self.variables])
        yield "#endif\n"


class Names:
    """Unique names for the variables of an FMU. A name that is taken gets a prefix; ``time`` is always taken."""

    def __init__(self) -> None:
        self._names = {TIME}

    def free(self, name: str, kind: str) -> str:
        """Return a name that no variable has yet, and reserve it: ``name``, or ``kind.name`` if ``name`` is taken."""
        name_of_variable = f"{kind}.{name}" if name in self._names else name
        self._names.add(name_of_variable)
        return name_of_variable


def _string(text: str) -> str:
    """Return a text as a C string literal. Quotes, trigraphs and characters beyond ASCII become octal escapes."""
    octal = (
        chr(byte) if (chr(byte).isalnum() and byte < 128) or byte in b" ._-" else f"\\{byte:03o}"
        for byte in text.encode()
    )
    return f'"{"".join(octal)}"'


def _array(of: str, name: str, values: list[str]) -> str:
    return f"static const {of} {name}[{len(values)}] = {{{', '.join(values)}}};"


FMI = "3.0"
REFERENCE = 0  # value reference (FMI's number of a variable) of the time; variable i has i + 1


def model_description(block: Block) -> bytes:
    """Return the content of ``modelDescription.xml``."""
    root = Element(
        "fmiModelDescription",
        fmiVersion=FMI,
        modelName=block.name,
        instantiationToken=block.token,
        description=block.description,
        generationTool="Surrogym",
        variableNamingConvention="flat",
    )
    SubElement(
        root,
        "CoSimulation",
        modelIdentifier=block.identifier,
        canHandleVariableCommunicationStepSize="true",
        fixedInternalStepSize=repr(block.period),
        canGetAndSetFMUState="true",
        canSerializeFMUState="true",
    )
    if units := sorted({one.unit for one in block.variables} - {""}):
        definitions = SubElement(root, "UnitDefinitions")
        for name in units:
            unit = SubElement(definitions, "Unit", name=name)
            if name == "rad":
                SubElement(unit, "BaseUnit", rad="1")
    SubElement(SubElement(root, "LogCategories"), "Category", name="logStatusError", description="refused calls")
    experiment = SubElement(root, "DefaultExperiment", startTime="0.0", stepSize=repr(block.period))
    if block.stop is not None:
        experiment.set("stopTime", repr(block.stop))
    variables = SubElement(root, "ModelVariables")
    SubElement(
        variables,
        "Float64",
        name=TIME,
        valueReference=str(REFERENCE),
        causality="independent",
        variability="continuous",
    )
    for reference, one in enumerate(block.variables, REFERENCE + 1):
        _add(variables, one, reference)
    structure = SubElement(root, "ModelStructure")
    outputs = [(ref, one) for ref, one in enumerate(block.variables, REFERENCE + 1) if one.causality == "output"]
    for reference, _ in outputs:
        SubElement(structure, "Output", valueReference=str(reference))
    for reference, one in outputs:
        if one.start is None:
            SubElement(structure, "InitialUnknown", valueReference=str(reference))
    return _to_xml(root)


def _add(variables: Element, one: Variable, reference: int) -> None:
    entry = SubElement(variables, one.kind, name=one.name, valueReference=str(reference), causality=one.causality)
    if one.description:
        entry.set("description", one.description)
    if one.causality == "parameter":
        entry.set("variability", "fixed")
    elif one.kind != "Float64":
        entry.set("variability", "discrete")
    if one.causality != "input":
        entry.set("initial", "calculated" if one.start is None else "exact")
    if one.unit:
        entry.set("unit", one.unit)
    for key, value in (("min", one.low), ("max", one.high), ("start", one.start)):
        if value is not None:
            entry.set(key, _number(one, value))


def _number(one: Variable, value: float) -> str:
    match one.kind:
        case "Float64":
            return repr(float(value))
        case "Int32":
            return str(int(value))
        case "Boolean":
            return "true" if value else "false"


def build_description(block: Block, sources: list[str]) -> bytes:
    """Return the content of ``sources/buildDescription.xml``, with the names of the C files to compile."""
    root = Element("fmiBuildDescription", fmiVersion=FMI)
    configuration = SubElement(root, "BuildConfiguration", modelIdentifier=block.identifier)
    files = SubElement(configuration, "SourceFileSet", language="C99")
    for name in sources:
        SubElement(files, "SourceFile", name=name)
    return _to_xml(root)


def _to_xml(root: Element) -> bytes:
    indent(root)
    body: bytes = tostring(root, encoding="utf-8")
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + body + b"\n"


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
