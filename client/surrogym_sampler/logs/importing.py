"""Import of a log into a surrogate: read the file, check its rows, draft a specification, send the steps in batches."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from surrogym_client.transport.api import Api
from surrogym_sampler.logs.outputs import rejected_file, require_outputs, write_draft
from surrogym_sampler.logs.reading import read
from surrogym_shared import patterns
from surrogym_shared.logs.checking import ReadLog, check_log, draft_log, is_of_rejected, write_rejected
from surrogym_shared.logs.roles import read_roles
from surrogym_shared.logs.rows import require_reward_unit
from surrogym_shared.logs.table import Floats, UnusableLog
from surrogym_shared.logs.transitions import TooFewSteps, Transitions
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import NewSample
from surrogym_shared.words import counted

BATCH = 2_000  # number of steps that are sent before each report of progress
SAMPLER = "log"
MOST_KNOWN = 2_000  # number of a surrogate's samples whose rewards are compared with those of the log

Progress = Callable[[float, str], None]
Mapping_ = Mapping[str, Any]


@dataclass(frozen=True)
class Imported:
    """The result of an import.

    Attributes:
        log: the log that was read, with its usable and its rejected rows.
        surrogate: name of the surrogate; None if no step was sent.
        sent: number of steps that were sent.
        duplicates: number of the sent steps that the surrogate had already.
        rejected_file: file of the rejected rows; None if there is none.
    """

    log: ReadLog
    surrogate: str | None = None
    sent: int = 0
    duplicates: int = 0
    rejected_file: Path | None = None

    @property
    def taken(self) -> int:
        """Number of steps that are new to the surrogate."""
        return self.sent - self.duplicates


@dataclass(frozen=True)
class Options:
    """Options for reading a log."""

    # roles of the columns: a file or its content; None infers the roles from the columns' names
    mapping: Path | Mapping_ | None = None
    spec: EnvironmentSpec | None = None  # specification to check the rows against; None drafts one
    budget: int | None = None  # number of real steps for the design; None takes that of the specification, or 0
    name: str = ""  # name of the environment in a drafted specification; the default is the file's name
    progress: Progress = field(default=lambda _share, _words: None)


def read_log(path: str | Path, options: Options | None = None) -> ReadLog:
    """Read a log and check its rows; nothing is sent to a server.

    Raises:
        UnusableLog: the file is not a log, or has columns whose role is not clear.
        TooFewSteps: no step is usable; or only one is, and a specification has to be drafted from it.
        OSError: a file can't be read.
    """
    path, options = Path(path), options or Options()
    options.progress(0.0, f"reading {path}")
    table, roles = read_roles(read(path), options.mapping)
    options.progress(0.1, f"checking {len(table)} rows")
    if options.spec is None:
        return draft_log(table, roles, options.name or path.stem, options.budget or 0)
    return check_log(table, roles, _with_budget(options.spec, options.budget))


def _with_budget(spec: EnvironmentSpec, budget: int | None) -> EnvironmentSpec:
    if budget is None:
        return spec
    return spec.model_copy(update={"design": spec.design.model_copy(update={"budget": budget})})


def send(api: Api, name: str, log: ReadLog, progress: Progress = lambda _share, _words: None) -> tuple[int, int]:
    """Send the usable steps of a log to a surrogate, in batches of ``BATCH``.

    An interrupted transfer can be repeated: the server recognises the log by its first steps and adds only those that
    it lacks.

    Args:
        api: the connection to the server.
        name: name of the surrogate.
        log: the log that was read.
        progress: called with the share of steps sent, in [0, 1], and a few words.

    Returns:
        The number of steps sent, and how many of those the surrogate had before.
    """
    steps, reward = log.steps, log.reward
    after = log.steps.origin
    first = duplicates = 0
    while first < len(steps):
        rows = range(first, min(first + BATCH, len(steps)))
        batch = [_sample(steps, reward, row) for row in rows]
        complete = rows.stop == len(steps)
        added = api.add_samples(name, SAMPLER, batch, purpose="logged", complete=complete, after=after)
        if added.restart is not None:
            first, duplicates, after = 0, 0, added.restart
            continue
        first, duplicates, after = rows.stop, duplicates + added.duplicates, added.digest
        progress(rows.stop / len(steps), f"{rows.stop} of {len(steps)} steps sent")
    return len(steps), duplicates


def import_log(
    path: str | Path,
    *,
    register: str | None = None,
    to: str | None = None,
    mapping: str | Path | Mapping_ | None = None,
    spec: EnvironmentSpec | None = None,
    budget: int | None = None,
    rejected: str | Path | None = None,
    draft: str | Path | None = None,
    url: str | None = None,
    token: str | None = None,
    progress: Progress = lambda _share, _words: None,
) -> Imported:
    """Check a log of real steps, and send its usable steps to a surrogate on a server.

    Args:
        path: a CSV, NPZ, Parquet or HDF5 file, or the name or folder of a Minari data set.
        register: name of a new surrogate, created with ``spec`` or with the drafted specification.
        to: name of an existing surrogate, against whose specification the rows are checked.
        mapping: roles of the columns: a JSON or TOML file, or the same as a dictionary; None infers them from the
            names.
        spec: the specification to check the rows against; None drafts one.
        budget: number of real steps that the design may take; 0 if no environment can take any. None takes that of
            ``spec``, or 0.
        rejected: file for the rows that can't be used; the default is a file beside the log.
        draft: file to which the specification is written before anything is sent.
        url: the server's address, as for ``Api``.
        token: the server's access token, as for ``Api``.
        progress: called with a share in [0, 1] and a few words.

    Raises:
        ValueError: both ``register`` and ``to`` are given, or ``to`` with ``spec``.
        UnusableLog: the file is not a log, the role of a column is not clear, ``register`` is not a valid name,
            ``rejected`` is the log or the mapping, an existing file beside the log does not contain rejected rows, or
            ``draft`` is a file with another specification.
        TooFewSteps: no step is usable; or only one is, and a specification has to be drafted from it.
        SurrogymClientError: the server can't be reached, or refuses a request.

    Examples:
        >>> import_log("reactor.csv", register="reactor").taken
    """
    _require_one_name(register, to, spec)
    given = Path(mapping) if isinstance(mapping, str) else mapping
    inputs = {"the log": Path(path), "the mapping": given if isinstance(given, Path) else None}
    require_outputs({"the file of rejected rows": None if rejected is None else Path(rejected)}, inputs)
    options = Options(given, spec, budget, progress=lambda share, words: progress(0.3 * share, words))
    if register is None and to is None:
        log, kept = _read_or_keep(Path(path), options, rejected)
        _write_draft(draft, log)
        return Imported(log, rejected_file=kept)
    with Api(url, token) as api:
        if to is not None:
            options = replace(options, spec=api.surrogate(to).spec)
        log, kept = _read_or_keep(Path(path), options, rejected)
        if to is not None:
            _require_reward_unit(log, api, to)
        _write_draft(draft, log)
        if register is not None:
            api.create_surrogate(register, log.spec)
        name = register or to or ""
        sent, duplicates = send(api, name, log, lambda share, words: progress(0.3 + 0.7 * share, words))
    return Imported(log, name, sent, duplicates, kept)


def _require_one_name(register: str | None, to: str | None, spec: EnvironmentSpec | None) -> None:
    if to is not None and (register is not None or spec is not None):
        raise ValueError(
            "expected the argument 'to' alone, got it with 'register' or 'spec': give 'register' for a new surrogate, "
            "or 'to' for an existing one, whose specification is used"
        )
    if register is not None and not re.fullmatch(patterns.NAME, register):
        raise UnusableLog(f"name of the surrogate: expected {patterns.IN_WORDS[patterns.NAME]}, got {register!r}")


def _write_draft(draft: str | Path | None, log: ReadLog) -> None:
    if draft is not None:
        write_draft(Path(draft), log.spec)


def _require_reward_unit(log: ReadLog, api: Api, name: str) -> None:
    """Refuse a log whose rewards seem to be in another unit than those of the surrogate's samples. If the specification
    declares the reward, any log is accepted, because its rewards are not learned from."""
    if log.spec.reward.kind == "learned" and not log.table.evaluated:
        known = [sample.reward for sample in islice(api.samples(name), MOST_KNOWN)]
        require_reward_unit(log.reward, np.array(known), name)


def keep_rejected(path: Path, log: ReadLog | TooFewSteps, where: str | Path | None = None) -> Path | None:
    """Write the rejected rows of a log to a file, and return its path.

    Args:
        path: the log.
        log: the log that was read, or the error that it has too few usable steps.
        where: the file; the default is beside the log.

    Returns:
        The file; None if no row was rejected and no earlier file of rejected rows exists.

    Raises:
        UnusableLog: the default file exists and does not contain rejected rows.
    """
    file, steps = rejected_file(path, where), log.steps
    foreign = where is None and file.exists() and not is_of_rejected(file)
    if not steps.rejected and (foreign or not file.exists()):
        return None
    if foreign:
        raise UnusableLog(
            f"{counted(len(steps.rejected), 'row')} of the log can't be used and would be written to {file}, but that "
            "file exists and does not contain rejected rows: give another file with --rejected"
        )
    write_rejected(file, log.table, steps)
    return file


def _read_or_keep(path: Path, options: Options, where: str | Path | None) -> tuple[ReadLog, Path | None]:
    """Read a log, and return it with the file of its rejected rows (see ``keep_rejected``). The file is written even if
    the log has too few usable steps."""
    try:
        log = read_log(path, options)
    except TooFewSteps as error:
        try:
            file = keep_rejected(path, error, where)
            words = f"{error}; all of these rows are in {file}" if error.steps.rejected else str(error)
        except UnusableLog as other:
            words = f"{error}; {other}"
        raise TooFewSteps(words, error.table, error.steps) from error
    return log, keep_rejected(path, log, where)


def _sample(steps: Transitions, reward: Floats, row: int) -> NewSample:
    return NewSample(
        coordinates=steps.q[row].tolist(),
        action=steps.u[row].tolist(),
        next_coordinates=steps.q_next[row].tolist(),
        reward=float(reward[row]),
        terminated=bool(steps.terminated[row]),
        truncated=bool(steps.truncated[row]),
    )
