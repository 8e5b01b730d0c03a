"""The content of an FMU: its variables, its period, and the C source of its step."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

from surrogym_shared.checks import require, require_unique

Kind = Literal["Float64", "Int32", "Boolean"]
Causality = Literal["input", "output", "parameter"]
KINDS: tuple[Kind, ...] = ("Float64", "Int32", "Boolean")
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
