"""Read and write a whole surrogate as one file: specification, model and real samples. The file contains no code and no
pickles.

The file is safetensors: eight bytes with the length of a JSON header, the header, then arrays as raw bytes. The model's
arrays and metadata are stored as the server exports them. The samples are in further arrays, whose names begin with
``samples.``. A further entry of the metadata, ``surrogate``, is JSON with format, name, specification, tolerances,
counts of real steps (ledger), and the errors with which each new sample was predicted before a model learned from it.
Any reader of safetensors can open the file. Without samples and this entry, it is the file of an exported model, which
the server can import.

Shapes: n samples, C coordinates, F action entries.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from surrogym_shared import patterns
from surrogym_shared.faults import first_fault
from surrogym_shared.spec import EnvironmentSpec

FORMAT = 1
MAX_FILE_BYTES = 256 * 1024 * 1024
MAX_HEADER_BYTES = 16 * 1024 * 1024
LENGTH_BYTES = 8
METADATA = "__metadata__"
OWN = "surrogate"  # key of the surrogate's own metadata in the file's header
SAMPLES = "samples."
PLANNER_HEAD = "surrogym-planner.json"  # name of the header in a planner's zip file, which contains such a file
LOGGED = "logged"  # name of the array that marks samples from a log; it is absent without such samples
DTYPES: dict[str, np.dtype[Any]] = {"F64": np.dtype("<f8"), "BOOL": np.dtype("?")}
UNREADABLE = (ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError)

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Header = dict[str, Any]


class NotASurrogateFile(ValueError):
    """The bytes are not a surrogate's file. The message says what was expected and what was found."""


@dataclass(frozen=True)
class RealSamples:
    """Real steps of a surrogate: those that its model was fitted to, and any later steps."""

    coordinates: Floats  # (n, C) the C coordinates before each of n steps
    action: Floats  # (n, F) action of F entries in each of n steps
    next_coordinates: Floats  # (n, C) the C coordinates after each of n steps
    reward: Floats  # (n,) reward of each of n steps
    terminated: Bools  # (n,) whether each of n steps ended the episode in a terminal state
    truncated: Bools  # (n,) whether each of n steps ended the episode for another reason
    # (n,) whether a step comes from a log, so that the budget does not count it; None: no step does.
    logged: Bools | None = None

    @classmethod
    def none(cls, coordinates: int, actions: int) -> Self:
        """Return arrays of 0 samples, for ``coordinates`` (C) coordinates and ``actions`` (F) action entries."""
        states, none = np.zeros((0, coordinates)), np.zeros(0, dtype=np.bool_)
        return cls(states, np.zeros((0, actions)), states, np.zeros(0), none, none)

    def __len__(self) -> int:
        return len(self.reward)


@dataclass(frozen=True)
class SurrogateFile:
    """Contents of a surrogate's file. The attribute ``model`` has the bytes of a safetensors file of the model, as the
    server exports and imports it.

    Examples:
        >>> SurrogateFile.load("pendulum.surrogate").spec.environment
        'Pendulum-v1'
    """

    name: str
    spec: EnvironmentSpec
    model: bytes
    samples: RealSamples
    tolerances: dict[str, float] = field(default_factory=dict)  # largest error that does not matter, by output
    ledger: dict[str, int] = field(default_factory=dict)  # counts of real steps by purpose, on the exporting server
    about: dict[str, Any] = field(default_factory=dict)  # what a prior was made from, as JSON of ``PriorAbout``

    def to_bytes(self) -> bytes:
        """Return the contents of the file.

        Raises:
            NotASurrogateFile: the attribute ``model`` is not the content of a safetensors file.
        """
        header, body = _split(self.model)
        samples = {name: getattr(self.samples, name) for name in RealSamples.__dataclass_fields__}
        arrays = {SAMPLES + name: array for name, array in samples.items() if array is not None}
        parts = [body]
        for name, array in arrays.items():
            kind = "BOOL" if array.dtype == np.bool_ else "F64"
            raw, start = np.ascontiguousarray(array, DTYPES[kind]).tobytes(), sum(map(len, parts))
            header[name] = {"dtype": kind, "shape": list(array.shape), "data_offsets": [start, start + len(raw)]}
            parts.append(raw)
        own = {
            "format": FORMAT,
            "name": self.name,
            "spec": self.spec.model_dump(mode="json"),
            "tolerances": self.tolerances,
            "ledger": self.ledger,
            "about": self.about,
        }
        header[METADATA] = header.get(METADATA, {}) | {OWN: json.dumps(own)}
        return _join(header, b"".join(parts))

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Read the contents of a surrogate's file, as ``to_bytes`` returned them.

        The arrays of the model are not checked: the code that reads models checks them against the specification.

        Raises:
            NotASurrogateFile: there are too many bytes, or they are not the content of a surrogate's file.
        """
        header, body = _split(data)
        try:
            own = json.loads(header[METADATA].pop(OWN))
            if own["format"] != FORMAT:
                raise NotASurrogateFile(
                    f"expected a surrogate's file of format {FORMAT}, got format {own['format']!r}: export the "
                    f"surrogate again with the version of surrogym that reads the file"
                )
            spec = EnvironmentSpec.model_validate(own["spec"])
            names = [one for one in RealSamples.__dataclass_fields__ if one != LOGGED or SAMPLES + one in header]
            entries = {one: header.pop(SAMPLES + one) for one in names}
            samples = RealSamples(**{name: _array(entry, body) for name, entry in entries.items()})
            end = min(entry["data_offsets"][0] for entry in entries.values())
            model = _join(header, body[:end])
            name = _name(own["name"])
            tolerances = {str(output): float(value) for output, value in own.get("tolerances", {}).items()}
            ledger = {str(purpose): int(steps) for purpose, steps in own.get("ledger", {}).items()}
            about = dict(own.get("about", {}))
        except NotASurrogateFile:
            raise
        except ValidationError as error:
            raise NotASurrogateFile(
                f"expected a valid specification in the surrogate's file, got this fault: {first_fault(error)}; export "
                f"the surrogate again"
            ) from error
        except UNREADABLE as error:
            raise NotASurrogateFile(
                f"expected a surrogate's file, got one that is damaged or of another kind ({error!r}): export "
                "the surrogate again by surrogym export"
            ) from error
        _require_shapes(spec, samples)
        return cls(name, spec, model, samples, tolerances, ledger, about)

    def about_as_json(self) -> str:
        """Return as JSON what a prior made from this file is learned from: the simulator that the attribute ``about``
        describes. If ``about`` is empty, it is this surrogate itself."""
        return json.dumps(self.about or {"source": self.name})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a surrogate's file.

        Raises:
            OSError: the file can't be read.
            NotASurrogateFile: the file is not a surrogate's.
        """
        with Path(path).open("rb") as file:
            try:
                return cls.from_bytes(file.read(MAX_FILE_BYTES + 1))
            except NotASurrogateFile as error:
                raise NotASurrogateFile(f"{path} can't be used: {error}") from error.__cause__


def _split(data: bytes) -> tuple[Header, bytes]:
    """Split a safetensors file into header and arrays."""
    if len(data) > MAX_FILE_BYTES:
        raise NotASurrogateFile(
            f"expected a surrogate's file of at most {MAX_FILE_BYTES} bytes, got more: "
            "export a surrogate with fewer samples"
        )
    length = int.from_bytes(data[:LENGTH_BYTES], "little")
    end = LENGTH_BYTES + length
    if len(data) < LENGTH_BYTES or end > len(data) or length > MAX_HEADER_BYTES:
        raise NotASurrogateFile(
            f"expected a surrogate's file, got {len(data)} bytes that are not in safetensors format: export "
            "it again by surrogym export"
        )
    try:
        header = json.loads(data[LENGTH_BYTES:end])
    except UNREADABLE as error:
        raise NotASurrogateFile(
            "expected a surrogate's file with a header in JSON, got other content: export the surrogate again"
        ) from error
    if not isinstance(header, dict) or not isinstance(header.get(METADATA, {}), dict):
        raise NotASurrogateFile(
            "expected a surrogate's file whose header names arrays, got other content: export the surrogate again"
        )
    return header, data[end:]


def _join(header: Header, body: bytes) -> bytes:
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % LENGTH_BYTES)  # the format requires that arrays begin at a multiple of eight
    return len(text).to_bytes(LENGTH_BYTES, "little") + text + body


def _array(entry: Any, body: bytes) -> NDArray[Any]:
    """Return the array that an entry of the header describes. If the entry is invalid, raises one of the exceptions
    that ``UNREADABLE`` lists."""
    dtype, shape, (start, stop) = DTYPES[entry["dtype"]], [int(n) for n in entry["shape"]], entry["data_offsets"]
    if min(shape, default=0) < 0 or not 0 <= start <= stop <= len(body):
        raise ValueError(
            f"expected an array within the file's {len(body)} bytes of arrays, got one from byte {start} to {stop}"
        )
    if math.prod(shape) * dtype.itemsize != stop - start:
        raise ValueError(f"expected an array of shape {shape} to fill its bytes, got {stop - start} bytes")
    raw = np.frombuffer(body[start:stop], dtype=np.uint8 if dtype == np.bool_ else dtype).reshape(shape)
    return raw.astype(np.bool_ if dtype == np.bool_ else np.float64)


def _name(name: object) -> str:
    if not isinstance(name, str) or not re.fullmatch(patterns.NAME, name):
        raise NotASurrogateFile(
            f"the surrogate's name in the file: expected {patterns.IN_WORDS[patterns.NAME]}, got {name!r}"
        )
    return name


def _require_shapes(spec: EnvironmentSpec, samples: RealSamples) -> None:
    n, c, f = len(samples.coordinates), len(spec.coordinates), spec.action.size
    shapes = {"coordinates": (n, c), "action": (n, f), "next_coordinates": (n, c)}
    for name in RealSamples.__dataclass_fields__:
        if (array := getattr(samples, name)) is None:
            continue
        shape, got = shapes.get(name, (n,)), array.shape
        if got != shape:
            raise NotASurrogateFile(
                f"array {SAMPLES}{name}: expected shape {shape}, got {got}; export the surrogate again"
            )
