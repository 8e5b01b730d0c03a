"""Text logs in other encodings and forms give the steps of the plain file, or are refused with the cause."""

from __future__ import annotations

import gzip
import itertools
import random
import zipfile
from pathlib import Path

import numpy as np
import pytest

from surrogym_sampler.logs import ReadLog, UnusableLog, read_log

NAMES = ("state_Größe", "state_x", "action_u", "reward")
ENCODINGS = {"utf-8": "", "utf-8-sig": "", "utf-16": "UTF-16", "utf-16-le": "UTF-16-LE", "utf-16-be": "UTF-16-BE"}
ENCODINGS |= {"utf-32": "UTF-32", "cp1252": "cp1252"}


def rows(seed: int, count: int = 20) -> list[tuple[float, ...]]:
    rng = random.Random(seed)
    return [tuple(round(rng.uniform(-9, 9), 3) for _ in NAMES) for _ in range(count)]


def text(drawn: list[tuple[float, ...]], delimiter: str = ",", heading: bool = True) -> str:
    lines = [NAMES] * heading + drawn
    return "".join(delimiter.join(map(str, line)) + "\n" for line in lines)


def read(folder: Path, content: bytes) -> ReadLog:
    (folder / "log.txt").write_bytes(content)
    return read_log(folder / "log.txt")


def assert_steps(log: ReadLog, drawn: list[tuple[float, ...]]) -> None:
    truth = np.array(drawn)
    assert (list(log.spec.coordinate_names), log.rejected) == (["Größe", "x"], [])
    np.testing.assert_array_equal(log.steps.q, truth[:-1, :2])
    np.testing.assert_array_equal(log.steps.q_next, truth[1:, :2])
    np.testing.assert_array_equal(log.steps.u, truth[:-1, 2:3])
    np.testing.assert_array_equal(log.reward, truth[:-1, 3])


@pytest.mark.parametrize("seed", range(24))
def test_a_text_log_in_any_encoding_and_delimiter_gives_the_same_steps(tmp_path: Path, seed: int):
    rng = random.Random(seed)
    encoding, delimiter = rng.choice(list(ENCODINGS)), rng.choice([",", ";", "\t", "|", " ", "   "])
    comment = rng.choice(["", "# rig 7, night shift; stand 2\n", "% a\n%\n", "// 1, 2, 3\n", "\n# x y\n\n"])
    drawn = rows(seed)
    content = comment + text(drawn, delimiter)
    if rng.random() < 0.3:  # numpy.savetxt
        content = "# rig\n# " + text(drawn, delimiter)
    if rng.random() < 0.3:
        content = content.replace("\n", rng.choice(["\r\n", "\r"]))
    log = read(tmp_path, content.encode(encoding))
    assert_steps(log, drawn)
    remark = ENCODINGS[encoding]
    assert not remark or any(remark in note for note in log.notes), "another encoding is named"


@pytest.mark.parametrize("seed", range(6))
def test_a_text_log_without_heading_is_refused_with_the_cause(tmp_path: Path, seed: int):
    content = text(rows(seed), random.Random(seed).choice(",;\t "), heading=False)
    with pytest.raises(UnusableLog, match=r"expected a heading that names the columns .* got a row of numbers"):
        read(tmp_path, content.encode())


def test_log_columns_named_by_numbers_can_be_mapped(tmp_path: Path):
    (tmp_path / "log.csv").write_text("0,1,2\n" + "".join(f"{k % 5},{k % 3}.5,{-k}\n" for k in range(9)))
    from surrogym_sampler.logs.importing import Options

    mapping = {"state": {"x": "0"}, "action": {"u": "1"}, "reward": "2"}
    assert len(read_log(tmp_path / "log.csv", Options(mapping=mapping)).steps)


def test_comment_lines_in_a_log_are_skipped_and_counted(tmp_path: Path):
    drawn = rows(0)
    lines = text(drawn).splitlines(keepends=True)
    log = read(tmp_path, "".join([*lines[:5], "# shift ends\n", *lines[5:]]).encode())
    assert_steps(log, drawn)
    assert "1 comment line between the rows left out" in log.notes


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(50), "Excel.*: save the table as CSV"),
        (gzip.compress(b"a,b\n1,2\n", mtime=0), "a file of gzip: decompress it first"),
        (b"SQLite format 3\x00" + bytes(50), "a database of SQLite"),
        (b"\x93NUMPY\x01\x00", "a single array of NumPy"),
        (b"\x89HDF\r\n\x1a\n" + bytes(200), "expected an HDF5 file in .*, got one that can't be read"),
        (b'[{"x": 1, "action": 2}]', "got JSON"),
        (b"<html><table>", "got JSON, XML or HTML"),
        (b"x,action\n1,2\n\x00\x01\x02", "got bytes in another format"),
        (b"\x81\x8d\x01abc", "got other bytes"),
        ("state_x,action,reward\n".encode("utf-16")[:-1], "UTF-16 .* the file may be cut off"),
    ],
)
def test_a_log_in_an_unsupported_format_is_refused_with_the_format_named(tmp_path: Path, content: bytes, says: str):
    if "HDF5" in says:
        pytest.importorskip("h5py")
    with pytest.raises(UnusableLog, match=says):
        read(tmp_path, content)


@pytest.mark.parametrize("whole", [True, False])
def test_an_excel_workbook_is_refused_with_a_hint_even_if_truncated(tmp_path: Path, whole: bool):
    path = tmp_path / "book.xlsx"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("[Content_Types].xml", "<Types/>")
        file.writestr("xl/workbook.xml", "<workbook/>")
    path.write_bytes(path.read_bytes()[: None if whole else 60])
    with pytest.raises(UnusableLog, match=r"got a workbook of Excel.*: save the table as CSV"):
        read_log(path)


def test_log_cells_must_be_decimal_numbers_or_true_or_false(tmp_path: Path):
    drawn = rows(1)
    lines = text(drawn).splitlines()
    odd = {3: "1_000", 7: "１２", 11: "0x1f"}
    for line, cell in odd.items():
        lines[line - 1] = ",".join([cell, *lines[line - 1].split(",")[1:]])
    lines = [line if k % 2 else line.rsplit(",", 2)[0] + ",True,False" for k, line in enumerate(lines, 1)]
    lines[0] = ",".join(NAMES)
    log = read(tmp_path, "\n".join(lines).encode())
    assert dict(log.rejected) == {line: f"state_Größe: expected a number, got {cell!r}" for line, cell in odd.items()}
    assert set(log.steps.u[log.table.lines[log.steps.row] % 2 == 0, 0]) == {1.0}


def test_a_repeated_column_name_is_refused_only_if_the_column_is_used(tmp_path: Path):
    names = ("state_x", "note", "note", "action", "reward")
    lines = [names, *itertools.islice(((k % 5, 1, 2, k % 3, -k) for k in itertools.count()), 9)]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(",".join(map(str, line)) for line in lines))
    log = read_log(path)
    assert len(log.steps)
    assert log.ignored == {"note": "it has no role"}
    path.write_text(path.read_text().replace("note", "action", 1))
    with pytest.raises(UnusableLog, match="got 'action' 2 times"):
        read_log(path)
