"""The declarations in an FMU's file: interface, platform, variables and default experiment. No native code is loaded.

Times are in seconds.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surrogym_sampler.original.errors import UnknownEnvironment

REAL = ("Real", "Float64", "Float32")  # FMI types of real numbers
DESCRIPTION = "modelDescription.xml"
MOST_ENTRIES, MOST_BYTES, MOST_XML_BYTES = 20_000, 2**30, 2**26
SHOWN = 20  # largest number of names in an error


@dataclass(frozen=True)
class Declared:
    """A scalar variable of an FMU. ``low``, ``high`` and ``start`` are its declared limits and start value; the other
    fields are those of the model description."""

    name: str
    reference: int
    type: str
    causality: str
    variability: str
    initial: str | None
    unit: str | None = None
    low: float | None = None
    high: float | None = None
    start: str | None = None

    @property
    def is_real(self) -> bool:
        return self.type in REAL

    @property
    def can_start(self) -> bool:
        """Whether the variable's value can be set before the FMU is initialised."""
        if self.variability == "constant":
            return False
        return self.causality in ("input", "parameter", "structuralParameter") or self.initial in ("exact", "approx")


@dataclass(frozen=True)
class Archive:
    """The declarations of an FMU for co-simulation on this platform.

    Attributes:
        path: the FMU's file.
        version: main version of FMI, 2 or 3.
        identifier: identifier of the model and of its native code.
        token: text by which the native code checks that the description belongs to it.
        library: path of the native code inside the file.
        variables: the scalar variables.
        states: names of the continuous states; empty if the file does not declare them.
        step: default communication step in seconds; None if not declared.
        stop: default end of a simulation that starts at 0, in seconds; None if not declared.
        snapshots: whether its whole state can be saved.
        serializes: whether a saved state can be converted to bytes.
        only_once: whether a process may make only one instance.
    """

    path: Path
    version: int
    identifier: str
    token: str
    library: str
    variables: tuple[Declared, ...]
    states: tuple[str, ...]
    step: float | None
    stop: float | None
    snapshots: bool
    serializes: bool
    only_once: bool

    def named(self, name: str) -> Declared:
        """Return the variable with this name.

        Raises:
            UnknownEnvironment: there is none.
        """
        for variable in self.variables:
            if variable.name == name:
                return variable
        known = [variable.name for variable in self.variables]
        more = f" and {len(known) - SHOWN} more" if len(known) > SHOWN else ""
        raise UnknownEnvironment(
            f"{self.path} has no scalar variable {name!r}: expected one of {', '.join(known[:SHOWN])}{more}"
        )

    def of_causality(self, causality: str) -> tuple[Declared, ...]:
        """Return the real variables with this causality, such as ``input``, in their order."""
        return tuple(v for v in self.variables if v.causality == causality and v.is_real)


def read_archive(path: Path) -> Archive:
    """Read the declarations of an FMU.

    Raises:
        UnknownEnvironment: the file is not an FMU for co-simulation of FMI 2.0 or 3.0 that can run on this platform.
        ImportError: fmpy is not installed.
    """
    from fmpy import read_model_description

    names = _names_in(path)
    if DESCRIPTION not in names:
        raise UnknownEnvironment(
            f"{path} has no {DESCRIPTION}, so it is not an FMU: export it anew from the tool that made it"
        )
    try:
        described: Any = read_model_description(str(path), validate=False)
    except Exception as error:  # fmpy passes on errors of zipfile and lxml, and raises TypeErrors and errors of its own
        words = "it lacks a part" if isinstance(error, AttributeError | TypeError | KeyError) else _first_line(error)
        raise UnknownEnvironment(
            f"the {DESCRIPTION} of {path} can't be read ({words}): export the FMU anew, or check it with "
            f"fmpy validate {path}"
        ) from error
    return _archive(path, names, described)


def _names_in(path: Path) -> list[str]:
    if not path.is_file():
        raise UnknownEnvironment(
            f"expected an FMU, or a JSON file that names one, got {path}, which does not exist: check the path"
        )
    try:
        with zipfile.ZipFile(path) as file:
            _require_bounded(path, file.infolist())
            damaged = file.testzip()
            names = file.namelist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError, RuntimeError) as error:
        raise UnknownEnvironment(
            f"{path} is not a zip archive, as an FMU is, or is a damaged one ({_first_line(error)}): copy or export "
            "the FMU anew"
        ) from error
    if damaged is not None:
        raise UnknownEnvironment(f"{damaged} in {path} is damaged: copy or export the FMU anew")
    return names


def _require_bounded(path: Path, entries: list[zipfile.ZipInfo]) -> None:
    """Refuse an archive that would be larger than any real FMU when unpacked. Only the archive's directory is read."""
    total = sum(entry.file_size for entry in entries)
    xml = max((entry.file_size for entry in entries if entry.filename.lower().endswith(".xml")), default=0)
    for what, size, most in (
        ("files", len(entries), MOST_ENTRIES),
        ("bytes inside", total, MOST_BYTES),
        ("bytes of an XML file", xml, MOST_XML_BYTES),
    ):
        if size > most:
            raise UnknownEnvironment(
                f"expected an FMU of at most {most:,} {what}, got {path} with {size:,}: export a smaller one"
            )


def _archive(path: Path, names: list[str], described: Any) -> Archive:
    version = int(described.fmiVersion.partition(".")[0])
    if version not in (2, 3):
        raise UnknownEnvironment(
            f"expected an FMU of FMI 2.0 or 3.0, got {path} of FMI {described.fmiVersion}: export it as one of these"
        )
    interface = described.coSimulation
    if interface is None:
        other = "model exchange" if described.modelExchange is not None else "scheduled execution"
        raise UnknownEnvironment(
            f"expected an FMU for co-simulation, got {path} for {other} only, which has no solver of its own: export "
            "it for co-simulation"
        )
    experiment = described.defaultExperiment
    start = _number(experiment and experiment.startTime) or 0.0
    stop = _number(experiment and experiment.stopTime)
    return Archive(
        path=path,
        version=version,
        identifier=interface.modelIdentifier,
        token=described.guid,
        library=_library(path, names, version, interface.modelIdentifier),
        variables=tuple(_declared(v) for v in described.modelVariables if not v.dimensions),
        states=_states(described),
        step=_number(experiment and experiment.stepSize),
        stop=None if stop is None else stop - start,
        snapshots=_truth(interface.canGetAndSetFMUstate),
        serializes=_truth(interface.canSerializeFMUstate),
        only_once=_truth(interface.canBeInstantiatedOnlyOncePerProcess),
    )


def _library(path: Path, names: list[str], version: int, identifier: str) -> str:
    """Return the path inside the archive of the native code for this platform.

    Raises:
        UnknownEnvironment: there is none.
    """
    from fmpy import platform, platform_tuple, sharedLibraryExtension

    here = platform if version == 2 else platform_tuple
    wanted = f"binaries/{here}/{identifier}{sharedLibraryExtension}"
    if wanted in names:
        return wanted
    others = sorted({name.split("/")[1] for name in names if name.startswith("binaries/") and name.count("/") == 2})
    sources = any(name.startswith("sources/") and name.endswith(".c") for name in names)
    way_out = f"fmpy compile {path} builds it from the sources inside" if sources else "export it for this platform"
    raise UnknownEnvironment(
        f"expected native code for {here} in {path}, got {', '.join(others) or 'none'}: {way_out}, or run the "
        "sampler on a machine that it was made for"
    )


def _states(described: Any) -> tuple[str, ...]:
    """Return the names of the scalar continuous states, from the declared derivatives; empty if a state is an array."""
    unknown = [entry.variable for entry in described.derivatives if entry.variable is not None]
    states = [variable.derivative for variable in unknown if variable.derivative is not None]
    if any(state.dimensions for state in states):
        return ()
    return tuple(state.name for state in states)


def _declared(variable: Any) -> Declared:
    shared = variable.declaredType  # the type may declare the limits and unit instead of the variable
    low, high, unit = (
        getattr(variable, key) if getattr(variable, key) is not None else getattr(shared, key, None)
        for key in ("min", "max", "unit")
    )
    return Declared(
        name=variable.name,
        reference=int(variable.valueReference),
        type=variable.type,
        causality=variable.causality,
        variability=variable.variability,
        initial=variable.initial,
        unit=unit,
        low=_number(low),
        high=_number(high),
        start=None if variable.start is None else str(variable.start),
    )


def _number(text: object) -> float | None:
    """Return a text of the model description as a finite number; None if it is not one."""
    try:
        number = float(str(text))
    except ValueError:
        return None
    return number if abs(number) < float("inf") else None


def _truth(value: object) -> bool:
    return value is True or value in ("true", "1")


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
