"""Read zip and npz files of unknown origin: sizes are read from headers and limited before anything is decompressed."""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from tokenize import TokenError
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

INFLATED = (
    zipfile.ZIP_STORED,
    zipfile.ZIP_DEFLATED,
)  # methods that numpy and torch write; others can't be limited while they decompress
ARRAY = ".npy"
MALFORMED = (
    ValueError,
    LookupError,
    TypeError,
    SyntaxError,
    TokenError,
    RecursionError,
    MemoryError,
    OverflowError,
)  # errors of NumPy's reader of headers, which parses them as Python


class Header(NamedTuple):
    """Shape and type of an array in an npz file, read before the array is made."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]


def read_entries(zipped: Path | bytes, limit: int) -> dict[str, bytes]:
    """Return the contents of a zip by name.

    Args:
        zipped: path of the file, or its contents.
        limit: most bytes that all entries together may have.

    Raises:
        OSError: the file can't be read.
        ValueError: the file is not a zip, is too large, or contradicts the sizes in its headers.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(zipped) if isinstance(zipped, bytes) else zipped) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
            if size > limit:
                raise ValueError(f"expected at most {limit} bytes inside, got {size}")
            return {entry.filename: _content(archive, entry) for entry in archive.infolist()}
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, zlib.error) as error:
        raise ValueError(f"expected a zip file, got content that can't be read as one: {error}") from error


def stored(entries: Mapping[str, bytes]) -> bytes:
    """Return an uncompressed zip of these contents."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return file.getvalue()


def read_arrays(
    npz: bytes, limit: int, require: Callable[[Mapping[str, Header]], None] = lambda _: None
) -> dict[str, NDArray[Any]]:
    """Return the arrays of an npz file by name. Nothing is unpickled.

    Args:
        npz: contents of the file.
        limit: most bytes that all arrays together may have.
        require: called with all headers by name before any array is made; raises ValueError to refuse them.

    Raises:
        ValueError: as ``read_entries`` and ``require``, or an array contradicts the size in its header.
    """
    entries = {name.removesuffix(ARRAY): content for name, content in read_entries(npz, limit).items()}
    require({name: _header(name, content) for name, content in entries.items()})
    return {
        name: np.lib.format.read_array(io.BytesIO(content), allow_pickle=False) for name, content in entries.items()
    }


def _content(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    """Decompress an entry to the size in its header, and no further."""
    if entry.compress_type not in INFLATED:
        raise ValueError(f"expected {entry.filename!r} stored or deflated, got compression {entry.compress_type}")
    with archive.open(entry) as file:
        content = file.read(entry.file_size)
    if len(content) != entry.file_size:
        raise ValueError(f"expected {entry.file_size} bytes of {entry.filename!r}, got {len(content)}")
    return content


def _header(name: str, content: bytes) -> Header:
    """Return the header of an array of numbers. Its size must match the bytes that follow it."""
    file = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(file)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(file)
    except MALFORMED as error:
        raise ValueError(f"expected an array {name!r} with a header of NumPy, got one that can't be read") from error
    named, came = math.prod(shape) * dtype.itemsize, len(content) - file.tell()
    if dtype.hasobject or min(shape, default=0) < 0 or named != came:
        raise ValueError(f"expected an array {name!r} of numbers in {named} bytes, got {dtype} in {came} bytes")
    return Header(shape, dtype)
