"""Decode the bytes of a text log. If they have another format, the error names it and says how to convert the file."""

from __future__ import annotations

import codecs

from surrogym_shared.logs.errors import UnusableLog

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
