"""A log into a surrogate: read, checked, drafted, and sent in batches that may be sent again."""

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
from surrogym_shared.logs.errors import UnusableLog
from surrogym_shared.logs.roles import read_roles
from surrogym_shared.logs.table import Floats, Table
from surrogym_shared.logs.too_few import TooFewSteps
from surrogym_shared.logs.transitions import Transitions
from surrogym_shared.logs.units import require_reward_unit
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import NewSample
from surrogym_shared.words import counted

BATCH = 2_000  # steps between two reports of progress
SAMPLER = "log"
MOST_KNOWN = 2_000  # samples of a surrogate that show how large its rewards are

Progress = Callable[[float, str], None]
Mapping_ = Mapping[str, Any]


@dataclass(frozen=True)
class Imported:
    """Result of an import."""

    log: ReadLog
    surrogate: str | None = None
    sent: int = 0
    duplicates: int = 0
    rejected_file: Path | None = None

    @property
    def taken(self) -> int:
        """Steps that are new to the surrogate."""
        return self.sent - self.duplicates


@dataclass(frozen=True)
class Options:
    """How a log is read. Raises nothing by itself."""

    mapping: Path | Mapping_ | None = None  # file, or what stands in one; None goes by the names of the columns
    spec: EnvironmentSpec | None = None  # that the log is checked against; None drafts one
    budget: int | None = None  # of the design; None is that of ``spec``, or 0
    name: str = ""  # of its environment; the file's by default
    progress: Progress = field(default=lambda _share, _words: None)


def read_log(path: str | Path, options: Options | None = None) -> ReadLog:
    """Read a log and check its rows; nothing is sent.

    Raises:
        UnusableLog: no log, or columns without a clear role.
        TooFewSteps: no usable step, or a single one where a specification is to be drafted.
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
    """Send the usable steps of a log to a surrogate; returns how many, and how many were there before.

    It may be interrupted, and sent again: the server knows the log by its beginning, and adds only what is missing.
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
    """Check a log of real steps, and give its usable steps to a surrogate on a server.

    Args:
        path: CSV, NPZ or Parquet, or the name of a Minari data set.
        register: name of a new surrogate, with the drafted specification, or with ``spec``.
        to: name of a surrogate that is there, by whose specification the rows are checked.
        mapping: what the columns are: a JSON or TOML file, or the same as a dictionary; None goes by their names.
        spec: the specification that the rows are checked against; None drafts one.
        budget: real steps that the design may ask for; 0 without a machine. None is that of ``spec``, or 0.
        rejected: where the rows go that can't be used; by default beside the log.
        draft: file to which the specification is written, before anything is sent.
        url, token: of the server, as ``Api`` takes them.
        progress: called with a share in [0, 1] and a few words.

    Raises:
        ValueError: both ``register`` and ``to``, or ``to`` with ``spec``.
        UnusableLog: no log, columns without a clear role, ``register`` is no name of a surrogate, ``rejected`` is
            the log or the mapping, the file beside the log is not one of rejected rows, or ``draft`` is a file with
            another specification.
        TooFewSteps: no usable step, or a single one where a specification is to be drafted.
        SurrogymClientError: as every request.

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
        raise ValueError("expected either register or to, and spec only together with register")
    if register is not None:
        _require_name(register)


def _write_draft(draft: str | Path | None, log: ReadLog) -> None:
    if draft is not None:
        write_draft(Path(draft), log.spec)


def _require_name(name: str) -> None:
    if not re.fullmatch(patterns.NAME, name):
        raise UnusableLog(f"name of the surrogate: expected {patterns.IN_WORDS[patterns.NAME]}, got {name!r}")


def _require_reward_unit(log: ReadLog, api: Api, name: str) -> None:
    """Refuse rewards that seem to be in another unit than those of the surrogate's samples. A declared reward
    is not learned, so the log may pay by another rule."""
    if log.spec.reward.kind == "learned" and not log.table.evaluated:
        known = [sample.reward for sample in islice(api.samples(name), MOST_KNOWN)]
        require_reward_unit(log.reward, np.array(known), name)


def keep_rejected(path: Path, log: ReadLog, where: str | Path | None = None) -> Path | None:
    """Write the rows that were set aside beside the log; None where there are none and no such file stands there.

    Raises:
        UnusableLog: the file beside the log is another one, and ``where`` names none.
    """
    return _keep(path, log.table, log.steps, where)


def _keep(path: Path, table: Table, steps: Transitions, where: str | Path | None) -> Path | None:
    file = rejected_file(path, where)
    foreign = where is None and file.exists() and not is_of_rejected(file)
    if not steps.rejected and (foreign or not file.exists()):
        return None
    if foreign:
        raise UnusableLog(
            f"{counted(len(steps.rejected), 'row')} of the log can't be used, and {file}, where they would go, is no "
            "file of rejected rows: name another one (--rejected)"
        )
    write_rejected(file, table, steps)
    return file


def _read_or_keep(path: Path, options: Options, where: str | Path | None) -> tuple[ReadLog, Path | None]:
    """The log, and the file of the rows that were set aside, which is written in any case."""
    try:
        log = read_log(path, options)
    except TooFewSteps as error:
        try:
            file = _keep(path, error.table, error.steps, where)
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
