"""Lock on a SQLite file, so that only one server uses it. The lock ends with its process, even after a crash.

A write-ahead log beside the file may belong to another database. The lock finds out for which database it was written,
from the first bytes of the database and the frames of the log (formats: sqlite.org/fileformat2.html,
sqlite.org/walformat.html).

SQLite itself would merge any log into any database of that name. So the first transaction of each log writes a mark of
its database into the header of page 1: the checksum of that database's header, and a random number that makes the next
header different from any before it.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import secrets
import struct
import threading
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from surrogym_server.errors import Unavailable

LOCKED_BYTE = 2**62  # position of the locked byte, beyond any database and far from the bytes that SQLite locks
# Command of fcntl for an open file description lock; None on systems without such locks.
WHOLE_DESCRIPTION = getattr(fcntl, "F_OFD_SETLK", None)
# First byte, and number of bytes, of a range of the file that SQLite locks: shared for a reader, exclusively for a
# program that merges the write-ahead log.
SQLITE_SHARED = (2**30 + 2, 510)
BUSY = (BlockingIOError, PermissionError)  # errors of fcntl if another process holds the lock

BESIDE = ("-wal", "-shm")  # suffixes of the names of SQLite's write-ahead log and of its index

Identity = tuple[int, int]  # device number and inode of a file, which identify it

_locked_files: set[Identity] = set()  # files on which this process holds a lock
_turn = threading.Lock()


class FileLock:
    """Lock on a SQLite file, held from construction to ``close`` or the end of the process. Child processes don't
    inherit it.

    The lock holds for all names and links of the file. A missing file is created. Close the lock after SQLite's
    connections, because closing any descriptor of a file drops SQLite's locks on it.

    Raises:
        Unavailable: another server holds the lock, the file can't be read and written, or its write-ahead log was
            written for another database.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        resolved = path.resolve()  # SQLite's write-ahead log lies beside the target of a symbolic link
        self._log, self._index = (resolved.with_name(resolved.name + suffix) for suffix in BESIDE)
        self._beside: dict[Path, Identity | None] = {}
        self._noted: bytes | None = None
        self._overwritten = False
        with _turn:
            if not path.exists():
                self._require_own_log(b"")
            # A second use of the file in this process is refused without opening it: closing it would drop this
            # process's locks.
            if _identity(path) in _locked_files:
                raise _unavailable(path)
            self._descriptors = [_lock_byte(path)] if WHOLE_DESCRIPTION else [_lock_beside(path), _open(path)]
            self._index_descriptor: int | None = None
            identity = _identity(path)
            assert identity is not None
            self._identity = identity
            _locked_files.add(identity)
        try:
            self._require_own_log(self.header())
        except Unavailable:
            self.close()
            raise

    def header(self) -> bytes:
        """Return the header of the SQLite file (its first 100 bytes), without changes that are only in its write-ahead
        log."""
        return os.pread(self._descriptors[-1], HEADER_BYTES, 0)

    def log_is_merged(self) -> bool:
        """Whether the whole write-ahead log is merged into the file, so that the next transaction may begin a new log.
        The caller must hold the write lock."""
        if self._index_descriptor is None:
            # The log's index exists, because SQLite creates it when the database is opened.
            self._index_descriptor = os.open(self._index, os.O_RDONLY | os.O_CLOEXEC)
        return is_merged(os.pread(self._index_descriptor, INDEX_BYTES, 0))

    def watch(self) -> None:
        """Remember the file's header, and which files its write-ahead log and the log's index are, to notice later
        changes by other programs."""
        self._beside = {path: _identity(path) for path in (self._log, self._index)}
        self._noted = self.header()

    def require_in_place(self) -> None:
        """Check that the path still leads to the locked file, and that its write-ahead log and the log's index are
        still the files that ``watch`` saw.

        Raises:
            Unavailable: one of these files was moved, replaced or deleted, or the database was overwritten.
        """
        if self._overwritten:
            raise self._foreign()
        if _identity(self._path) != self._identity:
            raise _displaced(self._path, "put the database file back in its place")
        for path, identity in self._beside.items():
            if _identity(path) != identity:
                raise _displaced(
                    path, "stop the server by Ctrl-C or SIGTERM, so that it can save the data that it still holds"
                )

    def is_as_noted(self) -> bool:
        """Whether the file's header is the one that ``watch`` or ``require_own_content`` remembered last. If so, no
        program has written to the file since then."""
        return self._noted is None or self.header() == self._noted

    def require_own_content(self) -> None:
        """Check that a changed header of the file comes from the file's own write-ahead log, and remember the new
        header.

        The caller must hold the write lock.

        Raises:
            Unavailable: another program has overwritten the file. SQLite is then kept from merging the write-ahead log
                into it.
        """
        if self.is_as_noted():
            return
        header = self.header()
        if not belongs(self._log, header):
            self._overwritten = True
            self._forbid_merging()
            raise self._foreign()
        self._noted = header

    def close(self) -> None:
        index = [] if self._index_descriptor is None else [self._index_descriptor]
        for descriptor in self._descriptors + index:
            os.close(descriptor)
        if self._descriptors:
            _locked_files.discard(self._identity)
        self._descriptors, self._index_descriptor = [], None

    def _require_own_log(self, header: bytes) -> None:
        if not belongs(self._log, header):
            raise Unavailable(
                f"expected a write-ahead log of {self._path}, got {self._log}, which was written for another database "
                f"or another state of it; nothing was changed: to keep {self._path} as it is, for example after "
                f"you restored it, move {self._log.name} and {self._index.name} away; to keep what the log "
                f"holds, put the database that it was written for back in place of {self._path.name}"
            )

    def _forbid_merging(self) -> None:
        """Keep SQLite from merging the write-ahead log into the overwritten file when SQLite's last connection is
        closed."""
        if WHOLE_DESCRIPTION:
            with contextlib.suppress(OSError):
                fcntl.fcntl(self._descriptors[-1], WHOLE_DESCRIPTION, _range(fcntl.F_RDLCK, *SQLITE_SHARED))

    def _foreign(self) -> Unavailable:
        return Unavailable(
            f"the database can't be used now: {self._path} was overwritten under the running server, and what it held "
            f"can't be saved; stop the server, move {self._log.name} and {self._index.name} away, make sure that "
            f"{self._path.name} is a whole copy, and start again"
        )


def _identity(path: Path) -> Identity | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def _lock_byte(path: Path) -> int:
    """Lock ``LOCKED_BYTE`` of a file by an open file description lock. Return the descriptor; closing it releases the
    lock."""
    descriptor = _open(path)
    assert WHOLE_DESCRIPTION is not None
    try:
        fcntl.fcntl(descriptor, WHOLE_DESCRIPTION, _range(fcntl.F_WRLCK, LOCKED_BYTE, 1))
    except OSError as error:
        os.close(descriptor)
        raise _unavailable(path, error) from None
    return descriptor


def _range(kind: int, first: int, count: int) -> bytes:
    """Return a ``struct flock`` for ``fcntl``: kind of lock, first byte, and number of bytes."""
    return struct.pack("hhqqi0q", kind, os.SEEK_SET, first, count, 0)


def _lock_beside(path: Path) -> int:
    """Lock the file ``.lock`` beside a database, for systems without open file description locks. Return its
    descriptor.

    All symbolic links to a database lead to the same lock.
    """
    resolved = path.resolve()
    descriptor = _open(resolved.with_name(resolved.name + ".lock"))
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(descriptor)
        raise _unavailable(path, error) from None
    return descriptor


def _open(path: Path) -> int:
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise Unavailable(
            f"expected a file to read and write as the database, got {path}: {error.strerror}; "
            "correct its permissions, or choose another path"
        ) from None


def _displaced(path: Path, way_out: str) -> Unavailable:
    return Unavailable(
        f"the database can't be used now: {path} was moved, replaced or deleted under the running server; {way_out}"
    )


def _unavailable(path: Path, error: OSError | None = None) -> Unavailable:
    why = "another server has it open" if error is None or isinstance(error, BUSY) else f"no lock: {error.strerror}"
    return Unavailable(f"expected to be the only server on the database {path}, but {why}")


HEADER_BYTES = 100  # size of the header of a SQLite database
USER_VERSION, APPLICATION_ID = slice(60, 64), slice(68, 72)  # fields of the header that SQLite leaves to applications
LOG_HEADER, FRAME_HEADER = struct.Struct(">8I"), struct.Struct(">6I")
BIG_ENDIAN = 1  # bit of a write-ahead log's magic number: byte order of words in its checksums
INDEX_BYTES = 136  # size of the first part of a write-ahead log's index: two headers, and number of merged frames
INDEX_VERSION = 3_007_000
WORD = 0xFFFF_FFFF


def marks(header: bytes) -> tuple[str, ...]:
    """Return SQL statements that mark the write-ahead log of the database with this header. The first transaction of
    the log has to execute them."""
    number = 1 + secrets.randbelow(2**31 - 1)
    return f"PRAGMA user_version={number}", f"PRAGMA application_id={_signed(zlib.crc32(header))}"


def belongs(log: Path, header: bytes) -> bool:
    """Whether the write-ahead log ``log`` may belong to the database whose header is ``header``.

    It does if the log contains nothing to merge, if the log has the mark of this database (see ``marks``), or if the
    log contains this header, because merging has begun. A log without a mark is from an older program, and may belong
    to a database without a mark.
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
    """Whether all frames of a write-ahead log are merged into its database, so that the next transaction may begin a
    new log.

    ``index`` is the first ``INDEX_BYTES`` bytes of the log's index, the file ``-shm``. The caller must hold the write
    lock, so that the index does not change.
    """
    if len(index) < INDEX_BYTES or struct.unpack_from("=I", index)[0] != INDEX_VERSION:
        return True  # if the index has an unknown format, the caller marks the log once more, which does no harm
    frames, merged = struct.unpack_from("=I", index, 16)[0], struct.unpack_from("=I", index, 96)[0]
    return bool(frames == merged)


def _is_marked(header: bytes | None) -> bool:
    return header is not None and any(header[USER_VERSION] + header[APPLICATION_ID])


def _signed(number: int) -> int:
    return number - 2**32 if number >= 2**31 else number


def _frames(file: BinaryIO) -> Iterator[tuple[tuple[int, ...], int]]:
    """Yield each frame that a write-ahead log contains since its last restart: the frame's header, and the position of
    its page in the log."""
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
    """Yield each version of the database's header (the start of page 1) that a write-ahead log contains."""
    for (page, *_), place in _frames(file):
        if page == 1:
            file.seek(place)
            yield file.read(HEADER_BYTES)


def _has_a_whole_transaction(file: BinaryIO) -> bool:
    """Whether a write-ahead log contains a complete transaction with right checksums, which SQLite would merge."""
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
        if size:  # only the last frame of a transaction has a size other than 0
            return True
    return False


def _checksum(data: bytes, order: str, sums: tuple[int, int]) -> tuple[int, int]:
    first, second = sums
    for left, right in struct.iter_unpack(f"{order}2I", data[: len(data) // 8 * 8]):
        first = (first + left + second) & WORD
        second = (second + right + first) & WORD
    return first, second
