"""Read a log from text: a heading, and rows of cells that are separated by commas, semicolons, tabs, bars or blanks.

The bytes of a text are decoded. If they have another format, the error names it and says how to convert the file.
Limits of the size of a log are checked before its cells are converted.
"""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from surrogym_shared.logs.table import Table, UnusableLog, is_date, is_number
from surrogym_shared.words import counted

MOST_ROWS = 2_000_000
MOST_CELLS = 50_000_000
MOST_COLUMNS = 1_000
LONGEST_CELL = 10_000  # largest number of characters of a cell


def require_sizes(where: object, rows: int, cells: int) -> None:
    """Raise ``UnusableLog`` if the log from ``where`` has more rows or cells than allowed."""
    if rows > MOST_ROWS:
        raise UnusableLog(f"expected at most {MOST_ROWS:,} rows in {where}, got {rows:,}: import a part of the log")
    if cells > MOST_CELLS:
        raise UnusableLog(f"expected at most {MOST_CELLS:,} cells in {where}, got {cells:,}: import a part of the log")


MARKED = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),  # listed before UTF-16, whose byte order mark is the beginning of that of UTF-32
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
WINDOWS = "cp1252"
SAMPLED = 4_096  # this many bytes at the start of a log show whether it is UTF-16 without a byte order mark
# In UTF-16, each Latin letter has a zero byte and another one. Less than this share of the other bytes may be zero.
MOST_ODD = 0.1

AS_CSV = "save the table as CSV"
DECOMPRESS = "decompress it first"
FOREIGN = (
    (0, b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "a file of Excel or another old program of Microsoft Office", AS_CSV),
    (0, b"\x1f\x8b", "a file of gzip", DECOMPRESS),
    (0, b"BZh", "a file of bzip2", DECOMPRESS),
    (0, b"\xfd7zXZ\x00", "a file of xz", DECOMPRESS),
    (0, b"\x28\xb5\x2f\xfd", "a file of zstd", DECOMPRESS),
    (0, b"7z\xbc\xaf\x27\x1c", "a file of 7-Zip", DECOMPRESS),
    (257, b"ustar", "a tar archive", "unpack it first"),
    (0, b"\x93NUMPY", "a single array of NumPy", "save the columns with numpy.savez(file, name=array, ...)"),
    (0, b"ARROW1", "a file of Arrow or Feather", "save it as Parquet"),
    (0, b"SQLite format 3\x00", "a database of SQLite", AS_CSV),
    (0, b"MATLAB 5.0 MAT-file", "a file of MATLAB", "save the table as CSV, such as with writetable"),
    (0, b"MDF     ", "a measurement file (MDF)", "save the channels as CSV"),
    (0, b"#ROSBAG", "a bag of ROS", "save the topics as CSV"),
    (0, b"\x89MCAP0", "a file of MCAP", "save the topics as CSV"),
    (0, b"%PDF", "a PDF", AS_CSV),
    (0, b"\x80\x04", "a pickle of Python", "save the columns with numpy.savez(file, name=array, ...)"),
    (0, b"\x80\x05", "a pickle of Python", "save the columns with numpy.savez(file, name=array, ...)"),
)


def decoded(content: bytes, where: str) -> tuple[str, tuple[str, ...]]:
    """Return a log as text, and remarks for its report if the encoding is not UTF-8.

    The encoding is that of the byte order mark, otherwise UTF-8. UTF-16 without a mark is recognised by its zero bytes.
    Other text without control characters is read as Windows' cp1252.

    Args:
        content: bytes of the log.
        where: source of the log, for messages.

    Raises:
        UnusableLog: the bytes have another format, or are not valid in their encoding.
    """
    for start, signature, name, way_out in FOREIGN:
        if content[start : start + len(signature)] == signature:
            raise UnusableLog(f"expected a log as text, NPZ, Parquet or HDF5 in {where}, got {name}: {way_out}")
    encoding = next((encoding for mark, encoding in MARKED if content.startswith(mark)), _unmarked(content))
    name = encoding.upper().removesuffix("-SIG")
    try:
        text = content.decode(encoding).removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        if encoding == "utf-8":
            return _windows(content, where)
        raise UnusableLog(
            f"expected text in {name} in {where}, as its first bytes show, got an invalid byte at position "
            f"{error.start}: the file may be cut off; write it again in UTF-8"
        ) from error
    if "\0" in text:
        raise UnusableLog(
            f"expected text, NPZ, Parquet or a surrogate's file in {where}, got bytes in another format: {AS_CSV}"
        )
    return text, () if name == "UTF-8" else (f"the text is in {name}",)


def _unmarked(content: bytes) -> str:
    """Guess the encoding of text without a byte order mark: UTF-8, or UTF-16 if every second byte is mostly zero."""
    sample = content[:SAMPLED]
    half = max(1, len(sample) // 2)
    first, second = sample[0::2].count(0) / half, sample[1::2].count(0) / half
    if second > 0.5 and first < MOST_ODD:
        return "utf-16-le"
    return "utf-16-be" if first > 0.5 and second < MOST_ODD else "utf-8"


def _windows(content: bytes, where: str) -> tuple[str, tuple[str, ...]]:
    try:
        text = content.decode(WINDOWS)
    except UnicodeDecodeError:
        text = "\0"
    if any((letter < " " and letter not in "\t\n\r\f") or letter == "\x7f" for letter in text):
        raise UnusableLog(f"expected text, NPZ, Parquet or a surrogate's file, got other bytes in {where}: {AS_CSV}")
    return text, (f"the text is not UTF-8, and was read as {WINDOWS} (Windows): check the names, or save it as UTF-8",)


DELIMITERS = ",;\t|"
BLANKS = " "
# First characters of lines that are no rows; Excel may write sep=; as the first line.
COMMENTS = ("#", "%", "//", "sep=")
LONGEST_NAME = 200  # largest number of characters of a column's name
JSON = re.compile(r"[{\[]\s*[{\[\"]")
# Blanks before a unit, which belong to the name (time [s]), also if blanks separate columns.
UNIT_APART = re.compile(r"\s+(?=[\[(])")
# Pandas gives columns without a name the last two names.
UNNAMED = re.compile(r"^(?:unnamed column \d+|Unnamed: \d+|__index_level_\d+__)$")


@dataclass(frozen=True)
class _Head:
    """Beginning of a text log: its comments, the first other line, and the line below that one."""

    comments: tuple[str, ...]
    line: str
    row: str
    before: int  # number of lines of the file before ``line``


def table_of_text(text: str, where: str, most_rows: int = MOST_ROWS, remarks: Sequence[str] = ()) -> Table:
    """Read a table from text with a heading.

    Lines before the heading that begin with ``#``, ``%`` or ``//`` are comments. If the first other line is a row of
    numbers, the last comment is the heading, as in files of ``numpy.savetxt``. A column without a name is left out.

    Args:
        text: the log.
        where: source of the text, for messages.
        most_rows: largest number of rows.
        remarks: sentences about the text for the report on the log, which begin the table's remarks.

    Raises:
        UnusableLog: the text has no heading, or too many rows, columns or cells.
    """
    if JSON.match(text.lstrip()[:20]) or text.lstrip()[:1] == "<":
        raise UnusableLog(f"expected a log with a heading and rows in {where}, got JSON, XML or HTML: write it as CSV")
    head = _head(text)
    delimiter = _delimiter(head)
    names, first, remarks = _heading(head, delimiter, where, list(remarks))
    _require_names(where, names)
    rows: list[list[str]] = []
    lines: list[int] = []
    faults: dict[int, str] = {}
    comments = 0
    for line, row in _rows(text, delimiter, first, where):
        if len(row) != len(names) and row[0].lstrip().startswith(COMMENTS):
            comments += 1
            continue
        if len(rows) == most_rows:
            raise UnusableLog(f"expected at most {most_rows:,} rows in {where}, got more: import a part of the log")
        if len(row) != len(names):
            faults[len(rows)] = f"expected {len(names)} columns, got {len(row)}"
        rows.append(row)
        lines.append(line)
    require_sizes(where, len(rows), len(rows) * len(names))
    if comments:
        remarks.append(f"{counted(comments, 'comment line')} between the rows left out")
    padded = [row if len(row) == len(names) else [*row, *([""] * len(names))][: len(names)] for row in rows]
    # Arrays of objects, because an array of text reserves the width of its longest cell in every row.
    columns = {
        name: np.array([row[i] for row in padded], dtype=object)
        for i, name in enumerate([name or f"unnamed column {place}" for place, name in enumerate(names, 1)])
        if names[i] == "" or names.count(names[i]) == 1
    }
    return Table(
        columns,
        np.array(lines, dtype=np.int64),
        faults,
        rows,
        delimiter,
        heading=tuple(names),
        unnamed=tuple(name for name in columns if is_unnamed(name)),
        repeated={name: count for name, count in Counter(names).items() if name and count > 1},
        remarks=tuple(remarks),
    )


def is_unnamed(name: str) -> bool:
    """Whether a name is only a placeholder: pandas' name of a table's index, or that of a column without a heading."""
    return UNNAMED.match(name) is not None


def _head(text: str) -> _Head:
    """Return the comments and the first two other lines of a text log. Missing lines are empty."""
    comments, lines, before = [], list[str](), 0
    for number, line in enumerate(io.StringIO(text, newline=None)):
        if not line.strip():
            continue
        if line.strip().strip('"').startswith(COMMENTS):
            comments += [line.strip()] if not lines else []
            continue
        before = before if lines else number
        lines.append(line.rstrip("\n"))
        if len(lines) == 2:
            break
    line, row = [*lines, "", ""][:2]
    return _Head(tuple(comments), line, row, before)


def _delimiter(head: _Head) -> str:
    """Return the delimiter that gives the first two lines the same number of cells. If there is none, return the
    delimiter that gives the first line the most cells."""

    def fit(delimiter: str) -> tuple[bool, int]:
        cells = len(_cells(head.line, delimiter))
        return cells > 1 and cells == len(_cells(head.row, delimiter)), cells

    best = max(DELIMITERS, key=fit)
    return best if fit(best)[1] > 1 or not head.line.strip().count(" ") else BLANKS


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter == BLANKS:
        return line.split()
    try:
        return next(csv.reader([line], delimiter=delimiter), [])
    except csv.Error:
        return [line]


def _heading(head: _Head, delimiter: str, where: str, remarks: list[str]) -> tuple[list[str], int, list[str]]:
    """Return the names of the columns, the number of lines before the first row, and ``remarks``, to which sentences
    about the heading were added."""
    skipped = f"{counted(len(head.comments), 'comment line')} before the heading left out"
    cells = [name.strip() for name in _cells(head.line, delimiter)]
    if not _is_row(cells):
        if head.comments:
            remarks.append(skipped)
        row = _cells(head.row, delimiter)
        if delimiter == BLANKS and len(cells) != len(row):
            cells_of_both = _cells(UNIT_APART.sub("", head.line), delimiter)
            cells = cells_of_both if len(cells_of_both) == len(row) else cells
        return cells, head.before + 1, remarks
    if head.comments:
        line = head.comments[-1].strip('"').lstrip("#%/ ")
        names = [name.strip() for name in _cells(line, delimiter)]
        if delimiter == BLANKS and len(names) != len(cells):
            names = _cells(UNIT_APART.sub("", line), delimiter)
        if len(names) == len(cells) and not _is_row(names):
            remarks.append("the heading is the comment line before the first row")
            return names, head.before, remarks
    raise UnusableLog(
        f"expected a heading that names the columns in {where}, got a row of numbers ({', '.join(cells[:4])[:60]}) as "
        "its first line: write a heading above it, such as time,level,action_valve,reward"
    )


def _is_row(cells: Sequence[str]) -> bool:
    """Whether the cells of a line are numbers or dates, so that it is a row and no heading. The line 0, 1, 2, ... is
    taken for a heading."""
    if list(cells) == [str(number) for number in range(len(cells))] and len(cells) > 1:
        return False
    return any(map(is_number, cells)) and all(not cell or is_number(cell) or is_date(cell) for cell in cells)


def _rows(text: str, delimiter: str, first: int, where: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the cells of each row that is not empty, with the number of its last line. The rows begin after the
    ``first`` lines of the text; ``where`` is the source of the text, for messages."""
    lines = islice(io.StringIO(text, newline=None), first, None)
    if delimiter == BLANKS:
        yield from ((first + number, cells) for number, line in enumerate(lines, 1) if (cells := line.split()))
        return
    reader = csv.reader(lines, delimiter=delimiter)
    try:
        yield from ((first + reader.line_num, row) for row in reader if row)
    except csv.Error as error:
        line = first + reader.line_num
        raise UnusableLog(f"expected CSV in {where}, got other text in line {line}: {error}") from error


def _require_names(where: str, names: Sequence[str]) -> None:
    if not any(names):
        raise UnusableLog(f"expected a log with a heading that names its columns, got none in {where}")
    if len(names) > MOST_COLUMNS:
        raise UnusableLog(f"expected at most {MOST_COLUMNS} columns in {where}, got {len(names)}: import some of them")
    if long := [name for name in names if len(name) > LONGEST_NAME]:
        raise UnusableLog(f"expected names of at most {LONGEST_NAME} characters in {where}, got {long[0][:40]!r}...")
