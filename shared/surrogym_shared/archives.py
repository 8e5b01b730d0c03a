"""Read zip and npz files of unknown origin: sizes are read from headers and limited before anything is decompressed."""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# Compression methods that numpy and torch write. The output of other methods can't be limited during decompression.
INFLATED = (
    zipfile.ZIP_STORED,
    zipfile.ZIP_DEFLATED,
)
ARRAY = ".npy"
SHOWN = 80  # an error shows at most this many characters of an entry's name
# Errors that NumPy's reader raises for a wrong array header, which it parses as Python code.
MALFORMED = (
    ValueError,
    LookupError,
    TypeError,
    SyntaxError,
    TokenError,
    RecursionError,
    MemoryError,
    OverflowError,
)


class Header(NamedTuple):
    """Shape and type of an array in an npz file, read before the array is made."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]


def read_entries(zipped: Path | bytes, limit: int) -> dict[str, bytes]:
    """Return the content of each entry of a zip file, by its name.

    Args:
        zipped: path of the file, or its contents.
        limit: largest number of bytes of all decompressed entries together.

    Raises:
        OSError: the file can't be read.
        ValueError: the file is no zip file, is too large, or contradicts the sizes in its headers.
    """
    with _open_zip(zipped, limit) as archive:
        return {entry.filename: _content(archive, entry) for entry in archive.infolist()}


def has_entry(path: Path, name: str) -> bool:
    """Whether a file is a zip file with an entry of this name."""
    try:
        with zipfile.ZipFile(path) as file:
            return name in file.namelist()
    except (OSError, zipfile.BadZipFile):
        return False


def stored(entries: Mapping[str, bytes]) -> bytes:
    """Return an uncompressed zip file with these entries, given as contents by name."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return file.getvalue()


def read_arrays(
    npz: Path | bytes, limit: int, require: Callable[[Mapping[str, Header]], None] = lambda _: None
) -> dict[str, NDArray[Any]]:
    """Return the arrays of an npz file by name. Nothing is unpickled.

    Args:
        npz: path of the file, or its contents.
        limit: largest number of bytes of all decompressed arrays together.
        require: called with the headers of all arrays by name, before any array is read; raises ValueError to refuse
            the file.

    Raises:
        OSError: the file can't be read.
        ValueError: raised by ``read_entries`` or ``require``, or an array contradicts the size in its header.
    """
    with _open_zip(npz, limit) as archive:
        entries = {entry.filename.removesuffix(ARRAY): entry for entry in archive.infolist()}
        require({name: _header(archive, entry, name) for name, entry in entries.items()})
        return {name: _array(archive, entry, name) for name, entry in entries.items()}


def require_finite(arrays: Mapping[str, NDArray[Any]], positive: str) -> None:
    """Raise ValueError if an array has NaN or infinity, or if the array named ``positive`` has a number of 0 or
    less."""
    for name, array in arrays.items():
        if not np.isfinite(array).all() or (name == positive and (array <= 0).any()):
            kind = "finite numbers above 0" if name == positive else "finite numbers"
            raise ValueError(f"array {name}: expected {kind}, got others")


@contextmanager
def _open_zip(zipped: Path | bytes, limit: int) -> Iterator[zipfile.ZipFile]:
    """Open a zip file whose entries have different names and at most ``limit`` bytes together; otherwise raise
    ValueError."""
    try:
        with zipfile.ZipFile(io.BytesIO(zipped) if isinstance(zipped, bytes) else zipped) as archive:
            _require_once(archive.namelist())
            size = sum(entry.file_size for entry in archive.infolist())
            if size > limit:
                raise ValueError(f"zip file: expected at most {limit} bytes after decompression, got {size}")
            yield archive
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, zlib.error) as error:
        raise ValueError(f"expected a zip file, got content that can't be read as one: {error}") from error


def _require_once(names: list[str]) -> None:
    """Raise ValueError if two entries have the same name: one reader would take the first, another the last."""
    if len(names) > len(set(names)):
        twice = next(name for name, count in Counter(names).items() if count > 1)
        raise ValueError(f"expected different names of the entries in a zip file, got {twice[:SHOWN]!r} twice")


def _stream(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> IO[bytes]:
    """Open an entry of a zip file, from which at most the number of bytes in its header can be read."""
    if entry.compress_type not in INFLATED:
        raise ValueError(
            f"expected {entry.filename!r} in a zip file uncompressed or deflated, got method {entry.compress_type}"
        )
    return archive.open(entry)


def _content(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    with _stream(archive, entry) as file:
        content = file.read(entry.file_size)
    if len(content) != entry.file_size:
        raise ValueError(
            f"expected {entry.file_size} bytes of {entry.filename!r}, got {len(content)}: the zip file is damaged"
        )
    return content


def _header(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, name: str) -> Header:
    """Read the header of an array in a zip entry. Its shape and type must match the number of bytes that follow."""
    with _stream(archive, entry) as file:
        try:
            version = np.lib.format.read_magic(file)
            form = np.lib.format
            read_header = form.read_array_header_1_0 if version == (1, 0) else form.read_array_header_2_0
            shape, _, dtype = read_header(file)
        except MALFORMED as error:
            raise ValueError(
                f"expected an array {name!r} with a header of NumPy, got one that can't be read"
            ) from error
        declared, came = math.prod(shape) * dtype.itemsize, entry.file_size - file.tell()
    if dtype.hasobject or min(shape, default=0) < 0 or declared != came:
        raise ValueError(
            f"array {name!r}: expected numbers that take as many bytes as the header says, got shape {shape} of "
            f"{dtype} in {came} bytes"
        )
    return Header(shape, dtype)


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, name: str) -> NDArray[Any]:
    """Read an array whose header was checked."""
    with _stream(archive, entry) as file:
        try:
            return np.asarray(np.lib.format.read_array(file, allow_pickle=False))
        except ValueError as error:
            raise ValueError(
                f"expected {entry.file_size} bytes of {name!r}, got fewer: the zip file is damaged"
            ) from error
