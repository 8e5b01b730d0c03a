"""Rows: the result of one run each, as a line of a CSV file. Rows of several runs and machines can be merged."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_type_hints
from uuid import uuid4

from surrogym_client.errors import SurrogymClientError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Key = tuple[str, str, int, int]
R = TypeVar("R", bound="DataclassInstance")


class UnusableRows(SurrogymClientError):
    """A file of rows can't be read; the message names the line and the reason."""


@dataclass(frozen=True)
class Row:
    """One run. Returns are over its real episodes; ``also_*`` are from the task's other starts, where it has any.

    ``specification`` is a hash of what was asked (specification, arm, budget, virtual steps, episodes, without the
    seed), ``configuration`` of that and the settings of the training. ``error`` is why a run ended badly: it counts as
    a seed, and as one that did not reach its target.
    """

    task: str
    arm: str
    seed: int
    budget: int
    initial: int | None = None
    adaptive: int | None = None
    real_steps: int | None = None
    mean: float | None = None
    iqm: float | None = None
    min: float | None = None
    max: float | None = None
    episodes: int | None = None
    success: float | None = None  # share of the episodes
    failures: int | None = None  # episodes without success
    also_mean: float | None = None
    also_min: float | None = None
    also_success: float | None = None
    reached: bool = False  # the task's target
    imagined: float | None = None
    promise: float | None = None  # median; None where the policy was handed over without one
    promise_low: float | None = None  # 5 % quantile
    promise_high: float | None = None  # 95 % quantile
    trusted: bool | None = None
    audit_steps: int | None = None  # real steps beyond ``real_steps``; 0 without an audit
    virtual_steps: int | None = None
    phase: str = ""
    confidence_index: float | None = None
    without: float | None = None  # mean return without the policy
    seconds: float | None = None
    commit: str = ""
    specification: str = ""
    configuration: str = ""
    machine: str = ""
    error: str = ""

    @property
    def key(self) -> Key:
        """Task, arm, budget, seed: rows of the same key are of the same cell."""
        return self.task, self.arm, self.budget, self.seed


COLUMNS = tuple(field.name for field in fields(Row))


def row_of(metrics: dict[str, Any]) -> Row:
    """The row of a run, from the metrics of its demo."""
    real, returns, also = metrics["real_queries"], metrics["real_return"], metrics["also"]
    success, promise, without = metrics["success_rate"], metrics.get("promise"), metrics.get("without")
    return Row(
        **{name: metrics[name] for name in ("task", "arm", "seed", "budget", "reached", "virtual_steps")},
        **{name: metrics[name] for name in ("confidence_index", "commit", "specification", "configuration", "machine")},
        **{name: returns[name] for name in ("mean", "iqm", "min", "max", "episodes")},
        initial=real["initial"],
        adaptive=real["adaptive"],
        real_steps=real["total"],
        success=success,
        failures=None if success is None else round((1 - success) * returns["episodes"]),
        also_mean=also and also["mean"],
        also_min=also and also["min"],
        also_success=also and also["success_rate"],
        imagined=metrics["imagined_return"],
        promise=promise and promise["median"],
        promise_low=promise and promise["low"],
        promise_high=promise and promise["high"],
        trusted=metrics.get("trusted"),
        audit_steps=real.get("audit"),
        without=without and without["mean"],
        phase=metrics["phase"] or "",
        seconds=metrics["seconds"]["total"],
    )


def read_rows(path: Path) -> list[Row]:
    """The rows of a CSV file; none where there is no file.

    Raises:
        UnusableRows: other columns than expected, or a value that is none.
    """
    return read_records(path, Row)


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Write rows as CSV, in place of what was there at once: a reader never sees half of it."""
    write_records(path, Row, rows)


def merge(*sources: Iterable[Row]) -> list[Row]:
    """All rows, sorted; of the same cell the last one, but never an error over a result."""
    merged: dict[Key, Row] = {}
    for row in (row for source in sources for row in source):
        if row.key not in merged or not row.error or merged[row.key].error:
            merged[row.key] = row
    return sorted(merged.values(), key=lambda row: row.key)


def read_records(path: Path, kind: type[R]) -> list[R]:
    """The lines of a CSV file as records of a dataclass; none where there is no file.

    Args:
        path: the file.
        kind: a dataclass of numbers, texts and truth values.

    Raises:
        UnusableRows: other columns than expected, a value that is none, an empty file, or no text in UTF-8.
    """
    if not path.exists():
        return []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return _records(path, csv.DictReader(file), kind)
    except (UnicodeDecodeError, csv.Error) as error:
        raise UnusableRows(f"{path}: expected a CSV file in UTF-8: {error}") from error


def _records(path: Path, reader: csv.DictReader[str], kind: type[R]) -> list[R]:
    columns, kinds = _columns(kind), get_type_hints(kind)
    given = tuple(reader.fieldnames or ())
    if not given:
        raise UnusableRows(f"{path}: expected a file of rows, got an empty one")
    if given != columns:
        raise UnusableRows(f"{path}: expected the columns {', '.join(columns)}, got {reader.fieldnames}")
    records = []
    for number, line in enumerate(reader, start=2):
        try:
            records.append(kind(**{name: _read(kinds[name], line[name]) for name in columns}))
        except (ValueError, TypeError) as error:
            raise UnusableRows(f"{path}, line {number}: {error}") from error
    return records


def write_records(path: Path, kind: type[R], records: Iterable[R]) -> None:
    """Write records of a dataclass as CSV, in place of what was there at once: a reader never sees half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.stem}-{uuid4().hex}.partial")  # another writer has another one
    try:
        with partial.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(_columns(kind))
            writer.writerows([_write(value) for value in asdict(record).values()] for record in records)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def _columns(kind: type[DataclassInstance]) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind))


def _read(kind: Any, text: str) -> Any:
    options = get_args(kind) or (kind,)
    if text == "" and type(None) in options:
        return None
    if options[0] is bool:
        return {"yes": True, "no": False}[text] if text in ("yes", "no") else _refuse(text)
    return options[0](text)


def _refuse(text: str) -> bool:
    raise ValueError(f"expected yes or no, got {text!r}")


def _write(value: Any) -> str:
    match value:
        case None:
            return ""
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.6g}"
        case _:
            return str(value)
