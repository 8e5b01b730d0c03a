"""Small files that are large inside are refused by their sizes, before anything of them is converted."""

from __future__ import annotations

import io
import resource
import zipfile
from pathlib import Path

import numpy as np
import pytest

from surrogym_sampler.logs import UnusableLog, read_log

MIB = 1024**2


def refused(path: Path, says: str) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(UnusableLog, match=says) as error:
        read_log(path)
    assert len(str(error.value)) < 1_000
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 * 1024, "KiB"


def zeros(file: zipfile.ZipFile, name: str, rows: int) -> None:
    """An array of zeros."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": (rows,)})
    with file.open(f"{name}.npy", "w", force_zip64=True) as entry:
        entry.write(header.getvalue())
        entry.write(bytes(rows))


def test_an_npz_with_too_many_rows_is_refused_by_its_headers(tmp_path: Path):
    with zipfile.ZipFile(tmp_path / "log.npz", "w", zipfile.ZIP_DEFLATED) as file:
        for name in ("x", "action"):
            zeros(file, name, 60 * MIB)
    refused(tmp_path / "log.npz", "expected at most 2,000,000 rows in .*, got 62,914,560")


def test_an_npz_that_decompresses_to_too_many_bytes_is_refused_before_reading(tmp_path: Path):
    with zipfile.ZipFile(tmp_path / "log.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        zeros(file, "x", MIB)
        file.getinfo("x.npy").file_size = 1025 * MIB + 128  # of the directory, which is written last
    refused(tmp_path / "log.npz", "expected at most 1073741824 bytes after decompression, got 1074790")


def test_an_npz_with_too_many_arrays_is_refused(tmp_path: Path):
    with zipfile.ZipFile(tmp_path / "log.npz", "w") as file:
        for number in range(2_000):
            zeros(file, f"x{number}", 1)
    refused(tmp_path / "log.npz", "expected at most 1,000 arrays in .*, got 2,000")


def test_a_parquet_file_with_too_many_rows_is_refused_by_its_metadata(tmp_path: Path):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    part = pyarrow.table({"x": np.zeros(1_000_000, np.int8), "action": np.zeros(1_000_000, np.int8)})
    with parquet.ParquetWriter(tmp_path / "log.parquet", part.schema) as file:
        for _ in range(4):
            file.write_table(part)
    assert (tmp_path / "log.parquet").stat().st_size < MIB
    refused(tmp_path / "log.parquet", "expected at most 2,000,000 rows in .*, got 4,000,000")


def test_a_parquet_file_with_too_many_list_cells_is_refused(tmp_path: Path):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    one = pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(np.zeros(52_000_000, np.int8)), 26_000_000)
    table = pyarrow.table({"obs": one, "action": [0.0, 1.0]})
    parquet.write_table(table, tmp_path / "log.parquet", use_dictionary=False)
    refused(tmp_path / "log.parquet", "expected at most 50,000,000 cells in .*, got 52,000,002")


def test_a_parquet_file_with_very_long_text_cells_is_refused(tmp_path: Path):
    """A file of 12 kB asked for 373 GiB."""
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    long = pyarrow.DictionaryArray.from_arrays(np.zeros(100_000, np.int32), ["x" * 4 * MIB])
    table = pyarrow.table({"run": long, "x": np.arange(100_000) % 7, "action": np.arange(100_000) % 3})
    parquet.write_table(table, tmp_path / "log.parquet", compression="zstd")
    assert (tmp_path / "log.parquet").stat().st_size < MIB
    refused(
        tmp_path / "log.parquet", "expected cells of at most 10,000 letters in the column 'run' of .*, got 4,194,304"
    )


def test_nested_and_binary_parquet_columns_are_ignored(tmp_path: Path):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    rng = np.random.default_rng(0)
    columns = {"x": rng.normal(size=6), "action": rng.normal(size=6), "run": ["a", "a", "a", None, "b", "b"]}
    columns |= {"info": [{"k": 1}] * 6, "tags": [["s"]] * 6, "raw": [b"\xff"] * 6}
    parquet.write_table(pyarrow.table(columns), tmp_path / "log.parquet")
    log = read_log(tmp_path / "log.parquet")
    assert {"info", "tags", "raw"} == set(log.ignored)
    assert log.steps.episodes[0] == 3


def test_an_error_about_many_columns_lists_only_a_few(tmp_path: Path):
    (tmp_path / "log.csv").write_text(",".join(f"x{k}" for k in range(900)) + "\n" + ",".join("1" * 900))
    with pytest.raises(UnusableLog, match=r"'x9' and 890 more\]") as error:
        read_log(tmp_path / "log.csv")
    assert len(str(error.value)) < 500
