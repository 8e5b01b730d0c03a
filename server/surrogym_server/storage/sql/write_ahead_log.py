"""Find out for which database a write-ahead log of SQLite was written, from the first bytes of the database and the
frames of the log (formats: sqlite.org/fileformat2.html, sqlite.org/walformat.html).

SQLite itself would merge any log into any database of that name. So the first transaction of each log writes a mark of
its database into the header of page 1: the checksum of that database's header, and a random number that makes the next
header different from any before it.
"""

from __future__ import annotations

import secrets
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

HEADER_BYTES = 100  # size of the header of a SQLite database
USER_VERSION, APPLICATION_ID = slice(60, 64), slice(68, 72)  # in the header; SQLite leaves both to applications
LOG_HEADER, FRAME_HEADER = struct.Struct(">8I"), struct.Struct(">6I")
BIG_ENDIAN = 1  # bit of the log's magic number: byte order of the words in its checksums
INDEX_BYTES = 136  # bytes to read of the log's index: two headers, then the position up to which the log was merged
INDEX_VERSION = 3_007_000
WORD = 0xFFFF_FFFF


def marks(header: bytes) -> tuple[str, ...]:
    """Return the statements by which the first transaction of a log marks it as belonging to this header's database."""
    number = 1 + secrets.randbelow(2**31 - 1)
    return f"PRAGMA user_version={number}", f"PRAGMA application_id={_signed(zlib.crc32(header))}"


def belongs(log: Path, header: bytes) -> bool:
    """Whether SQLite may merge the file ``log`` into the database that begins with ``header``.

    It may if there is nothing to merge, if the log begins with the mark of this database, or if the header comes from
    the log because merging has begun. A log without a mark is from an older program, and may belong to a database
    without a mark.
    """
    try:
        file = log.open("rb")
    except FileNotFoundError:
        return True
    with file:
        first = None
        for page in _first_pages(file):
            if page == header:
                return True
            first = page if first is None else first
        if first is not None and first[APPLICATION_ID] == struct.pack(">I", zlib.crc32(header)):
            return True
        if len(header) == HEADER_BYTES and not _is_marked(header) and not _is_marked(first):
            return True
        return not _has_a_whole_transaction(file)


def is_merged(index: bytes) -> bool:
    """Whether all of a log is in the database, so that the next transaction may begin a new log.

    ``index`` is the beginning of the log's index, read by a caller with the right to write.
    """
    if len(index) < INDEX_BYTES or struct.unpack_from("=I", index)[0] != INDEX_VERSION:
        return True  # an unnecessary mark does no harm
    frames, merged = struct.unpack_from("=I", index, 16)[0], struct.unpack_from("=I", index, 96)[0]
    return bool(frames == merged)


def _is_marked(header: bytes | None) -> bool:
    return header is not None and any(header[USER_VERSION] + header[APPLICATION_ID])


def _signed(number: int) -> int:
    return number - 2**32 if number >= 2**31 else number


def _frames(file: BinaryIO) -> Iterator[tuple[tuple[int, ...], int]]:
    """The headers of the frames of the log's present generation, and the positions of their pages."""
    file.seek(0)
    begin = file.read(LOG_HEADER.size)
    if len(begin) < LOG_HEADER.size:
        return
    _, _, page_size, _, *salts, _, _ = LOG_HEADER.unpack(begin)
    place = LOG_HEADER.size
    while len(head := file.read(FRAME_HEADER.size)) == FRAME_HEADER.size:
        frame = FRAME_HEADER.unpack(head)
        if list(frame[2:4]) != salts:
            return
        place += FRAME_HEADER.size
        yield frame, place
        place += page_size
        file.seek(place)


def _first_pages(file: BinaryIO) -> Iterator[bytes]:
    """Yield each version of the database's header that the log contains."""
    for (page, *_), place in _frames(file):
        if page == 1:
            file.seek(place)
            yield file.read(HEADER_BYTES)


def _has_a_whole_transaction(file: BinaryIO) -> bool:
    """Whether the log contains a transaction that SQLite would merge. After a power loss its checksums may be wrong."""
    file.seek(0)
    begin = file.read(LOG_HEADER.size)
    if len(begin) < LOG_HEADER.size:
        return False
    magic, _, page_size, *_ = LOG_HEADER.unpack(begin)
    order = ">" if magic & BIG_ENDIAN else "<"
    sums = _checksum(begin[:24], order, (0, 0))
    if sums != LOG_HEADER.unpack(begin)[6:]:
        return False
    for (page, size, *_, first, second), place in _frames(file):
        file.seek(place)
        sums = _checksum(struct.pack(">2I", page, size) + file.read(page_size), order, sums)
        if sums != (first, second):
            return False
        if size:  # the last frame of a transaction has the database's size, others have 0
            return True
    return False


def _checksum(data: bytes, order: str, sums: tuple[int, int]) -> tuple[int, int]:
    first, second = sums
    for left, right in struct.iter_unpack(f"{order}2I", data[: len(data) // 8 * 8]):
        first = (first + left + second) & WORD
        second = (second + right + first) & WORD
    return first, second
