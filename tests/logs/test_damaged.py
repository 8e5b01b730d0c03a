"""Damaged files of logs are refused in a sentence, whatever the reader of their format raises."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from surrogym_sampler.logs import UnusableLog, read_log

RNG = np.random.default_rng(0)
COLUMNS = {"action": RNG.normal(size=60), "reward": RNG.normal(size=60)}


def parquet(path: Path, **columns: object) -> Path:
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    parquet.write_table(pyarrow.table(columns), path)
    return path


@pytest.mark.parametrize("kept", [4, 300, -1])
def test_a_truncated_parquet_log_is_refused(tmp_path: Path, kept: int):
    path = parquet(tmp_path / "log.parquet", x=RNG.normal(size=60), **COLUMNS)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(UnusableLog, match=r"expected a Parquet file in .*, got one that can't be read: "):
        read_log(path)


@pytest.mark.parametrize("odd", [[1.0], None])
@pytest.mark.parametrize("place", [0, 59])
def test_parquet_lists_of_different_lengths_are_refused(tmp_path: Path, odd: list[float] | None, place: int):
    lists: list[list[float] | None] = [[1.0, 2.0]] * 60
    lists[place] = odd
    path = parquet(tmp_path / "log.parquet", obs=lists, **COLUMNS)
    with pytest.raises(UnusableLog, match="expected lists of the same length in the column obs"):
        read_log(path)


@pytest.mark.parametrize(
    "header",
    [
        b"{'descr': '<f8', 'fortran_order': False, 'shape': " + b"(" * 3_000 + b"3,)}",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (3,",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (-1,)}",
        b"\xff\xfe",
        b"",
    ],
)
def test_an_npz_log_with_an_invalid_array_header_is_refused(tmp_path: Path, header: bytes):
    with zipfile.ZipFile(tmp_path / "log.npz", "w") as file:
        file.writestr("x.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header) + 1) + header + b"\n")
    with pytest.raises(UnusableLog, match="array 'x'"):
        read_log(tmp_path / "log.npz")
