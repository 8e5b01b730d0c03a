"""A zip or npz that would grow beyond its bound, or lies about its sizes, costs no memory."""

from __future__ import annotations

import io
import json
import pickle
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from surrogym_shared.archives import read_arrays, read_entries, stored
from surrogym_shared.network import ARRAYS, HEAD, MAX_BYTES, Network

MEBIBYTE = 1024 * 1024
BOMB = 64 * MEBIBYTE


@contextmanager
def little_memory(mebibytes: float = 4) -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < mebibytes * MEBIBYTE
    finally:
        tracemalloc.stop()


def deflated(name: str, content: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)
    return file.getvalue()


def lying(name: str, content: bytes, size: int) -> bytes:
    """A deflated zip whose headers name another size, with the checksum of what is read up to there."""
    honest, checksum = bytearray(deflated(name, content)), zlib.crc32(content[:size])
    central = honest.index(b"PK\x01\x02")
    struct.pack_into("<I", honest, 14, checksum)
    struct.pack_into("<I", honest, 22, size)
    struct.pack_into("<I", honest, central + 16, checksum)
    struct.pack_into("<I", honest, central + 24, size)
    return bytes(honest)


def array_file(header: str, body: bytes) -> bytes:
    padded = header.encode() + b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(padded)) + padded + body


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_an_archive_with_a_repeated_entry_name_is_refused():
    """The last entry was read, where another program that reads the same policy takes the first."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for content in (array_of(1.0), array_of(2.0)):
            archive.writestr("mean.npy", content)
    for read in (read_entries, read_arrays):
        with pytest.raises(ValueError, match=r"'mean\.npy' twice"):
            read(file.getvalue(), MEBIBYTE)


def array_of(value: float) -> bytes:
    file = io.BytesIO()
    np.save(file, np.array([value]))
    return file.getvalue()


def test_archive_entries_are_read_back_unchanged(tmp_path: Path):
    entries = {"a": b"1", "folder/b": b"", "c": bytes(1_000)}
    (tmp_path / "a.zip").write_bytes(stored(entries))
    assert read_entries(tmp_path / "a.zip", 1_001) == read_entries(stored(entries), 1_001) == entries


@pytest.mark.parametrize("write", [np.savez, np.savez_compressed])
def test_arrays_of_an_npz_are_read(write):
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.zeros(0), "c": np.array(3), "d": np.asfortranarray(np.eye(3))}
    file = io.BytesIO()
    write(file, **arrays)
    read = read_arrays(file.getvalue(), MEBIBYTE)
    assert list(read) == list(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype


def test_a_zip_that_decompresses_beyond_its_limit_is_refused_unread():
    bomb = deflated("a", bytes(BOMB))
    with (
        little_memory(),
        pytest.raises(ValueError, match=f"expected at most {MEBIBYTE} bytes after decompression, got {BOMB}"),
    ):
        read_entries(bomb, MEBIBYTE)


@pytest.mark.parametrize("size", [10, 2 * MEBIBYTE])
def test_a_zip_entry_larger_than_its_header_says_is_not_decompressed_further(size: int):
    bomb = lying("a", bytes(BOMB), size)
    with little_memory(8):
        assert len(read_entries(bomb, 2 * MEBIBYTE)["a"]) == size


def test_a_zip_entry_smaller_than_its_header_says_is_refused():
    with pytest.raises(ValueError, match="expected 2000 bytes of 'a', got 1000"):
        read_entries(lying("a", bytes(1_000), 2_000), MEBIBYTE)


@pytest.mark.parametrize("kind", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_zip_with_an_unbounded_compression_method_is_refused(kind: int):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", kind) as archive:
        archive.writestr("a", b"content")
    with pytest.raises(ValueError, match="'a' in a zip file uncompressed or deflated, got method"):
        read_entries(file.getvalue(), MEBIBYTE)


@pytest.mark.parametrize("content", [b"", b"no zip", deflated("a", bytes(100))[:-30]], ids=["empty", "text", "cut"])
def test_an_invalid_zip_is_refused(content: bytes):
    with pytest.raises(ValueError, match="expected a zip file, got content"):
        read_entries(content, MEBIBYTE)


@pytest.mark.parametrize(
    ("shape", "dtype"), [("(1000000000000,)", "<f8"), ("(-1, -1)", "<f8"), ("(1,)", "|O"), ("(1,)", "<f4")]
)
def test_an_npz_array_of_other_size_than_its_header_says_is_refused(shape: str, dtype: str):
    content = array_file(f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}", bytes(8))
    with little_memory(), pytest.raises(ValueError, match="expected numbers"):
        read_arrays(stored({"a.npy": content}), MEBIBYTE)


def test_pickled_objects_in_an_npz_are_not_unpickled():
    file = io.BytesIO()
    np.savez(file, a=np.array([{"code": 1}], dtype=object))
    with pytest.raises(ValueError, match="array 'a': expected numbers"):
        read_arrays(file.getvalue(), MEBIBYTE)


def network_file(path: Path, npz: bytes) -> Path:
    path.write_bytes(stored({HEAD: b'{"version": 1, "counts": []}', ARRAYS: npz}))
    return path


def test_a_network_file_with_huge_arrays_is_refused(tmp_path: Path):
    file = io.BytesIO()
    np.savez_compressed(file, hidden=np.zeros(BOMB // 8))
    path = network_file(tmp_path / "policy.zip", file.getvalue())
    assert path.stat().st_size < MEBIBYTE
    with (
        little_memory(),
        pytest.raises(ValueError, match=f"expected at most {MAX_BYTES} bytes after decompression, got"),
    ):
        Network.load(path)


@pytest.mark.parametrize("units", [3, 4])
def test_a_network_file_with_inconsistent_array_shapes_is_refused(tmp_path: Path, units: int):
    file = io.BytesIO()
    parts = {"mean": 2, "deviation": 2, "hidden": (2, 3), "hidden_bias": 3, "output": (units, 1), "output_bias": 1}
    np.savez(file, **{name: np.ones(shape) for name, shape in parts.items()}, low=[-1.0], high=[1.0])
    path = network_file(tmp_path / "policy.zip", file.getvalue())
    if units == 3:
        assert Network.load(path)(np.zeros((5, 2))).shape == (5, 1)
        return
    with pytest.raises(ValueError, match="not a policy of"):
        Network.load(path)


def test_a_pickle_instead_of_a_network_file_is_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="not a policy of"):
        Network.load(network_file(tmp_path / "policy.zip", pickle.dumps([1])))


PENDULUM = {"mean": 3, "deviation": 3, "hidden": (3, 1), "hidden_bias": 1, "output": (1, 1), "output_bias": 1}
PENDULUM |= {"low": 1, "high": 1}
MANY = 500_000


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        ({"hidden": (20_000, 1, 3, 1), "hidden_bias": (1, 20_000, 1)}, r"expected hidden(_bias)? as floats of shape"),
        ({"hidden": (MANY, 1, 3, 1), "hidden_bias": (1, 400_000, 1)}, r"expected hidden(_bias)? as floats of shape"),
        ({"deviation": (MANY, 1)}, r"expected deviation as floats of shape \(3,\), got float64 of \(500000, 1\)"),
        ({"output": (MANY, 1, 1)}, "expected output as floats of shape"),
        ({"mean": ()}, "expected mean as floats of shape"),
        ({"low": (MANY, 1)}, "expected low as floats of shape"),
        ({"extra": 1}, "expected the arrays .*, got .*extra"),
    ],
    ids=str,
)
def test_network_arrays_that_would_broadcast_to_a_huge_size_are_refused(tmp_path: Path, monkeypatch, shapes, message):
    file = io.BytesIO()
    np.savez_compressed(file, **{name: np.zeros(shape) for name, shape in (PENDULUM | shapes).items()})
    path = network_file(tmp_path / "policy.zip", file.getvalue())
    monkeypatch.setattr(np.lib.format, "read_array", lambda *_, **__: pytest.fail("an array was made"))
    with little_memory(64), pytest.raises(ValueError, match=message):
        Network.load(path)


@pytest.mark.parametrize(
    ("head", "message"),
    [
        ({"counts": [3]}, "expected 3 outputs, .*, got 1"),
        ({"counts": [-1, 2]}, r"counts\.0: expected a number greater than 0"),
        ({"counts": ["a"]}, r"counts\.0: expected a whole number"),
        ({"counts": [], "version": 3}, "version: expected 1 or 2"),
        ({"counts": [], "version": 2}, "expected the arrays bias0, bias1, .*, got deviation, hidden"),
        ({"counts": [], "version": 2, "layers": 9}, "layers: expected a number less than or equal to 8"),
        (
            {"counts": [1] * 50_000},
            "expected the entry surrogym-network.json of a policy's file to have at most 65536 bytes, got ",
        ),
    ],
    ids=["too many", "negative", "text", "version", "names", "layers", "long"],
)
def test_a_network_file_whose_output_layer_does_not_fit_is_refused(tmp_path: Path, head, message):
    file = io.BytesIO()
    np.savez(file, **{name: np.zeros(shape) for name, shape in PENDULUM.items()})
    path = tmp_path / "policy.zip"
    path.write_bytes(stored({HEAD: json.dumps({"version": 1} | head).encode(), ARRAYS: file.getvalue()}))
    with pytest.raises(ValueError, match=message):
        Network.load(path)


def test_a_network_file_too_large_for_the_memory_is_refused_in_a_sentence(tmp_path: Path, monkeypatch):
    def full(*_: object) -> None:
        raise MemoryError("Unable to allocate 1 GiB")

    monkeypatch.setattr("surrogym_shared.archives.read_arrays", full)
    with pytest.raises(ValueError, match=r"policy\.zip is not a policy of surrogym train: Unable to allocate 1 GiB"):
        Network.load(network_file(tmp_path / "policy.zip", b""))
