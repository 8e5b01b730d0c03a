"""Logs of real steps for a watcher: read once, or in pieces while they grow."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

from surrogym_sampler.logs import ReadLog, UnusableLog, read_log
from surrogym_sampler.logs.importing import Options
from surrogym_sampler.logs.reading import format_of
from surrogym_shared.logs.checking import check_log
from surrogym_shared.logs.columns import LogMapping
from surrogym_shared.logs.roles import read_roles
from surrogym_shared.logs.table import Ints
from surrogym_shared.logs.text import decoded, table_of_text
from surrogym_shared.logs.transitions import TooFewSteps
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.evaluation.comparing import StepOfEpisode

LOOK_SECONDS = 1.0  # seconds between two reads of a log that grows
LATEST = 1_000  # if a growing log has twice as many rows, all but this number of latest rows are dropped
CHUNK = 2**20  # largest number of bytes that one read takes from a stream

Mapping_ = Path | Mapping[str, Any] | None


def steps_after(log: ReadLog, line: int) -> list[StepOfEpisode]:
    """Return the steps of a log that come after a line number. The field ``number`` of each step is its own line
    number."""
    steps, reward, lines = log.steps, log.reward, log.table.lines[log.steps.row]
    return [
        StepOfEpisode(
            episode=0,
            number=int(lines[i]),
            coordinates=tuple(steps.q[i].tolist()),
            action=tuple(steps.u[i].tolist()),
            next_coordinates=tuple(steps.q_next[i].tolist()),
            reward=float(reward[i]),
            terminated=bool(steps.terminated[i]),
        )
        for i in range(len(steps))
        if lines[i] > line
    ]


def read_once(path: Path, mapping: Mapping_, spec: EnvironmentSpec) -> ReadLog:
    """Read a log, and check its rows by a specification.

    Raises:
        UnusableLog: the file is not a log, its columns don't fit the specification or are in other units, or it was
            recorded at another sampling period.
        OSError: the file can't be read.
    """
    return read_log(path, Options(mapping, spec))


def read_growing(chunks: Iterable[bytes], where: str, mapping: Mapping_, spec: EnvironmentSpec) -> Iterator[ReadLog]:
    """Read a text log in pieces, and yield its latest rows after each piece that completes a line.

    Args:
        chunks: the pieces.
        where: name of the log, for messages.
        mapping: roles of the columns; None infers them from their names.
        spec: specification to check the rows against.

    Raises:
        UnusableLog: the text is not a log, its columns don't fit the specification or are in other units, or it was
            recorded at another sampling period.
    """
    growing = _Growing(where, mapping, spec)
    for chunk in chunks:
        if (log := growing.add(chunk)) is not None:
            yield log


def chunks_of_file(path: Path) -> Iterator[bytes]:
    """Yield the content of a file and what is added to it, without end.

    Raises:
        UnusableLog: the file is not a text log, or has become shorter.
        OSError: the file can't be read.
    """
    if (kind := format_of(path)) != "csv":
        raise UnusableLog(f"expected a log of text (CSV) that grows, got {kind} in {path}: leave out --follow")
    read = 0
    while True:
        with path.open("rb") as file:
            if (size := file.seek(0, os.SEEK_END)) < read:
                raise UnusableLog(
                    f"expected the log {path} to grow, got {size} bytes after {read}: watch it from the start again"
                )
            file.seek(read)
            chunk = file.read(size - read)
        read += len(chunk)
        yield chunk
        time.sleep(LOOK_SECONDS)


def chunks_of_stream(stream: BinaryIO) -> Iterator[bytes]:
    """Yield what arrives from a stream as soon as it arrives. At the end, yield a line end, because the last line may
    lack one."""
    while chunk := os.read(stream.fileno(), CHUNK):
        yield chunk
    yield b"\n"


class _Growing:
    """The heading and the latest rows of a text log that grows."""

    def __init__(self, where: str, mapping: Mapping_, spec: EnvironmentSpec) -> None:
        self._where, self._spec = where, spec
        self._mapping: Mapping_ | LogMapping = mapping
        # complete lines that are kept; and the beginning of a line that has not arrived completely
        self._text, self._rest = b"", b""
        self._dropped = 0  # number of dropped lines between the heading and the latest rows

    def add(self, chunk: bytes) -> ReadLog | None:
        """Add a chunk of bytes to the text, and return the latest rows, including those of the chunk. None if the chunk
        completes no line, or if no row is a usable step."""
        complete, end, self._rest = (self._rest + chunk).rpartition(b"\n")
        if not complete.strip():
            return None
        self._text += complete + end
        text, remarks = decoded(self._text, self._where)
        table = table_of_text(text, self._where, remarks=remarks)
        if not len(table):
            return None
        table, roles = read_roles(replace(table, lines=table.lines + self._dropped), self._mapping)
        if len(table) > 2 * LATEST:
            self._drop(table.lines)
            self._mapping = roles.mapping
        try:
            return check_log(table, roles, self._spec)
        except TooFewSteps:
            return None

    def _drop(self, rows: Ints) -> None:
        """Drop all rows but the latest; ``rows`` (n,) contains the line of each row."""
        first, kept = int(rows[0]) - self._dropped - 1, int(rows[-LATEST]) - self._dropped - 1
        lines = self._text.splitlines(keepends=True)
        self._text = b"".join([*lines[:first], *lines[kept:]])
        self._dropped += kept - first
