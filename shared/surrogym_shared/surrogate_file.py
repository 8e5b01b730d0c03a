"""A whole surrogate as one file: specification, model and real samples. Nothing in it is code, nothing is pickled.

The file is safetensors: eight bytes with the length of a JSON header, the header, then arrays as raw bytes. The model's
arrays and its own metadata stand as the server exports them; beside them are ``samples.*`` arrays and, as metadata
``surrogate``, format, name, specification, tolerances and ledger. So any reader of safetensors opens it, and the
server's reader of models takes what ``model`` gives back.

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

from surrogym_shared.spec import NAME_IN_WORDS, NAME_PATTERN, EnvironmentSpec

FORMAT = 1
MAX_FILE_BYTES = 256 * 1024 * 1024
MAX_HEADER_BYTES = 16 * 1024 * 1024
LENGTH_BYTES = 8
METADATA = "__metadata__"
OWN = "surrogate"  # key of this file's own metadata
SAMPLES = "samples."
LOGGED = "logged"  # of the samples; files without a log have no such array
DTYPES: dict[str, np.dtype[Any]] = {"F64": np.dtype("<f8"), "BOOL": np.dtype("?")}
UNREADABLE = (ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError)

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Header = dict[str, Any]


class NotASurrogateFile(ValueError):
    """The bytes are no surrogate's file; says what was expected and what came."""


@dataclass(frozen=True)
class RealSamples:
    """The real steps that the model was learned from, and any since."""

    coordinates: Floats  # (n, C)
    action: Floats  # (n, F)
    next_coordinates: Floats  # (n, C)
    reward: Floats  # (n,)
    terminated: Bools  # (n,)
    truncated: Bools  # (n,)
    logged: Bools | None = None  # (n,) those of a log, which cost no budget; None: none is

    def __len__(self) -> int:
        return len(self.reward)


@dataclass(frozen=True)
class SurrogateFile:
    """``model`` is a model's own safetensors file, as the server exports it and takes it back.

    Examples:
        >>> SurrogateFile.load("pendulum.surrogate").spec.environment
        'Pendulum-v1'
    """

    name: str
    spec: EnvironmentSpec
    model: bytes
    samples: RealSamples
    tolerances: dict[str, float] = field(default_factory=dict)  # by output, as the model was judged
    ledger: dict[str, int] = field(default_factory=dict)  # real steps by purpose, where it comes from

    def to_bytes(self) -> bytes:
        """The whole as one file. Raises ``NotASurrogateFile`` where ``model`` is no safetensors file."""
        header, body = _split(self.model)
        given = {name: getattr(self.samples, name) for name in RealSamples.__dataclass_fields__}
        arrays = {SAMPLES + name: array for name, array in given.items() if array is not None}
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
        }
        header[METADATA] = header.get(METADATA, {}) | {OWN: json.dumps(own)}
        return _joined(header, b"".join(parts))

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Read what ``to_bytes`` gave.

        The model's arrays are left to the reader of models, who checks them against the specification.

        Raises:
            NotASurrogateFile: too large, or not of this form.
        """
        header, body = _split(data)
        try:
            own = json.loads(header[METADATA].pop(OWN))
            if own["format"] != FORMAT:
                raise NotASurrogateFile(f"expected a surrogate's file of format {FORMAT}, got {own['format']!r}")
            spec = EnvironmentSpec.model_validate(own["spec"])
            names = [one for one in RealSamples.__dataclass_fields__ if one != LOGGED or SAMPLES + one in header]
            entries = {one: header.pop(SAMPLES + one) for one in names}
            samples = RealSamples(**{name: _array(entry, body) for name, entry in entries.items()})
            end = min(entry["data_offsets"][0] for entry in entries.values())
            model = _joined(header, body[:end])
            name = _name(own["name"])
            tolerances = {str(output): float(value) for output, value in own.get("tolerances", {}).items()}
            ledger = {str(purpose): int(steps) for purpose, steps in own.get("ledger", {}).items()}
        except NotASurrogateFile:
            raise
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise NotASurrogateFile(f"its specification contradicts itself: {where}: {first['msg']}") from error
        except UNREADABLE as error:
            raise NotASurrogateFile(f"expected a surrogate's file, got {len(data)} bytes: {error!r}") from error
        _require_shapes(spec, samples)
        return cls(name, spec, model, samples, tolerances, ledger)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file.

        Raises:
            OSError: it can't be read.
            NotASurrogateFile: it is none.
        """
        with Path(path).open("rb") as file:
            try:
                return cls.from_bytes(file.read(MAX_FILE_BYTES + 1))
            except NotASurrogateFile as error:
                raise NotASurrogateFile(f"{path}: {error}") from error.__cause__


def _split(data: bytes) -> tuple[Header, bytes]:
    """Header and arrays of a safetensors file."""
    if len(data) > MAX_FILE_BYTES:
        raise NotASurrogateFile(f"expected a file of at most {MAX_FILE_BYTES} bytes, got more")
    length = int.from_bytes(data[:LENGTH_BYTES], "little")
    end = LENGTH_BYTES + length
    if len(data) < LENGTH_BYTES or end > len(data) or length > MAX_HEADER_BYTES:
        raise NotASurrogateFile(f"expected a surrogate's file, got {len(data)} bytes that are no safetensors")
    try:
        header = json.loads(data[LENGTH_BYTES:end])
    except UNREADABLE as error:
        raise NotASurrogateFile("expected a header of JSON, got something else") from error
    if not isinstance(header, dict) or not isinstance(header.get(METADATA, {}), dict):
        raise NotASurrogateFile("expected a header of names and arrays, got something else")
    return header, data[end:]


def _joined(header: Header, body: bytes) -> bytes:
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % LENGTH_BYTES)  # arrays begin at a multiple of eight, as the format wants it
    return len(text).to_bytes(LENGTH_BYTES, "little") + text + body


def _array(entry: Any, body: bytes) -> NDArray[Any]:
    """An array of the header's entry; raises one of ``UNREADABLE`` where it does not describe one."""
    dtype, shape, (start, stop) = DTYPES[entry["dtype"]], [int(n) for n in entry["shape"]], entry["data_offsets"]
    if min(shape, default=0) < 0 or not 0 <= start <= stop <= len(body):
        raise ValueError(f"an array of shape {shape} at {start} to {stop} of {len(body)} bytes")
    if math.prod(shape) * dtype.itemsize != stop - start:
        raise ValueError(f"an array of shape {shape} in {stop - start} bytes")
    raw = np.frombuffer(body[start:stop], dtype=np.uint8 if dtype == np.bool_ else dtype).reshape(shape)
    return raw.astype(np.bool_ if dtype == np.bool_ else np.float64)


def _name(given: object) -> str:
    if not isinstance(given, str) or not re.fullmatch(NAME_PATTERN, given):
        raise NotASurrogateFile(f"its name: expected {NAME_IN_WORDS}, got {given!r}")
    return given


def _require_shapes(spec: EnvironmentSpec, samples: RealSamples) -> None:
    n, c, f = len(samples.coordinates), len(spec.coordinates), spec.action.size
    wanted = {"coordinates": (n, c), "action": (n, f), "next_coordinates": (n, c)}
    for name in RealSamples.__dataclass_fields__:
        if (array := getattr(samples, name)) is None:
            continue
        expected, got = wanted.get(name, (n,)), array.shape
        if got != expected:
            raise NotASurrogateFile(f"{SAMPLES}{name}: expected shape {expected}, got {got}")
