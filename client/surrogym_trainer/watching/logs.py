"""Logs of real steps for a watcher: read once, or again whenever they have grown."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from surrogym_sampler.logs import ReadLog, UnusableLog, read_log
from surrogym_sampler.logs.importing import Options
from surrogym_sampler.logs.reading import format_of
from surrogym_shared.logs.checking import check_log
from surrogym_shared.logs.decoding import decoded
from surrogym_shared.logs.roles import read_roles
from surrogym_shared.logs.text import table_of_text
from surrogym_shared.logs.too_few import TooFewSteps
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.evaluation.comparing import StepOfEpisode

LOOK_SECONDS = 1.0  # between two looks at a log that grows
READING = 10.0  # a look waits for this many times the seconds that reading took
UNITS = (1.0, 1e3, 1e6, 1e9)  # of a clock in a second
OFF = 0.1  # share by which the interval of a log may differ from the sampling period

Mapping_ = Path | Mapping[str, Any] | None


def steps_after(log: ReadLog, line: int) -> list[StepOfEpisode]:
    """Return the steps of a log after a line, each with its line as its ``number``."""
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
    """Read a log and check its rows by a specification.

    Raises:
        UnusableLog: it is no log, its columns don't fit the specification or are in other units, or it was recorded at
            another sampling period.
        OSError: it can't be read.
    """
    return _checked(read_log(path, Options(mapping, spec)), spec)


def read_growing(path: Path, mapping: Mapping_, spec: EnvironmentSpec) -> Iterator[ReadLog]:
    """Read a log of text again and again, without end. A last line without its end is left for the next look.

    Raises:
        UnusableLog: as of ``read_once``, or the log is no text, or has become shorter.
        OSError: it can't be read.
    """
    if (kind := format_of(path)) != "csv":
        raise UnusableLog(f"expected a log of text (CSV) that grows, got {kind} in {path}: leave out --follow")
    size = 0
    while True:
        began = time.monotonic()
        content = path.read_bytes()
        complete = content[: content.rfind(b"\n") + 1]
        if len(complete) < size:
            raise UnusableLog(f"expected {path} to grow, got {len(complete)} bytes after {size}: watch the new log")
        if len(complete) > size:
            size = len(complete)
            if (log := _of_text(complete, path, mapping, spec)) is not None:
                yield log
        time.sleep(max(LOOK_SECONDS, READING * (time.monotonic() - began)))


def _of_text(content: bytes, path: Path, mapping: Mapping_, spec: EnvironmentSpec) -> ReadLog | None:
    """Return the log in complete lines; None while it has no usable step."""
    text, remarks = decoded(content, str(path))
    table, roles = read_roles(table_of_text(text, str(path), remarks=remarks), mapping)
    if not len(table):
        return None
    try:
        return _checked(check_log(table, roles, spec), spec)
    except TooFewSteps:
        return None


def _checked(log: ReadLog, spec: EnvironmentSpec) -> ReadLog:
    """Refuse a log of another sampling period than the declared one. Its clock may count seconds or parts of them."""
    period, interval = spec.sampling_period, log.steps.interval
    if period is None or interval is None or log.roles.time is None:
        return log
    if not any(abs(interval / (unit * period) - 1) <= OFF for unit in UNITS):
        raise UnusableLog(
            f"expected a step every {period:g} s, as the specification declares by sampling_period, got one every "
            f"{interval:g} of the column {log.roles.time!r}"
        )
    return log
