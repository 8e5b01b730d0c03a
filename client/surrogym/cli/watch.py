"""``surrogym watch``: compare a log of real steps with the model, and withdraw a promise if the plant has changed."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from surrogym.cli.groups import Output, Service, add
from surrogym.cli.options import names_of_surrogates

if TYPE_CHECKING:
    from collections.abc import Iterator

    from surrogym_shared.logs.checking import ReadLog
    from surrogym_shared.terminal import Update
    from surrogym_trainer.watching.watcher import Alarm, Watcher

SHOWN = 8  # most rows to show that can't be used


def register(app: typer.Typer) -> None:
    """Add ``surrogym watch`` to the app."""
    add(app, "watch", command)


def command(
    context: typer.Context,
    surrogate: Annotated[str, typer.Argument(help="Name of the surrogate.", autocompletion=names_of_surrogates)],
    log: Annotated[Path, typer.Argument(help="Log of real steps: CSV, NPZ, Parquet, HDF5 or a Minari data set.")],
    policy: Annotated[
        str, typer.Option(help="Policy whose promise depends on the machine: a version, an alias, or latest.")
    ],
    mapping: Annotated[
        Path | None, typer.Option("--map", help="JSON or TOML file that says what each column of the log means.")
    ] = None,
    follow: Annotated[
        bool, typer.Option("--follow", "-f", help="Continue with lines that are added to the log, until Ctrl-C.")
    ] = False,
    false_alarm_steps: Annotated[
        float, typer.Option(min=100, help="Average number of real steps up to a false alarm, at least.")
    ] = 10_000,
    *,
    service: Service,
    output: Output,
) -> None:
    """Find out whether the machine has changed, from a log.

    Each step is compared with the model's prediction. No model learns from it. If the machine has changed, the command
    says which output differs, by how much and where, and ends with exit status 1. The policy's promise is not trusted
    from then on. The model should fit the machine at first: surrogym audit tests that.

    Example: surrogym watch pendulum log.csv --policy production --follow
    """
    from surrogym.cli.errors import CommandError
    from surrogym_shared.terminal import on_interrupt, progress
    from surrogym_trainer.watching.logs import read_growing, read_once
    from surrogym_trainer.watching.watcher import Watcher

    with service.connect(context) as api:
        view, version = api.surrogate(surrogate), api.policies.get(surrogate, policy.rpartition("@")[2]).version
        if view.fidelity is None:
            raise CommandError(f"{surrogate!r} has no model yet: there is nothing to compare the log with")
        watcher = Watcher(api, view, false_alarm_steps)
        logs = read_growing(log, mapping, view.spec) if follow else iter([read_once(log, mapping, view.spec)])
        with (
            on_interrupt(lambda: f"interrupted; no drift in {watcher.compared} real steps"),
            progress("watch", quiet=output.quiet) as update,
        ):
            read, alarm = _watched(watcher, logs, update)
        stored = None if alarm is None else watcher.withdraw(version, alarm)
    named = f"{surrogate}@{version}"
    result = {
        "policy": named,
        "model": view.model_version,
        "compared": watcher.compared,
        "left_out": watcher.left_out,
        "evidence": watcher.evidence,
        **_of_log(read),
        "drift": None if alarm is None else {**asdict(alarm), "region": alarm.region and alarm.region._asdict()},
        "trusted": None if stored is None else stored.trusted,
    }
    output.give(result, lambda: "\n".join(_words(log, read, watcher, alarm, named)))
    if alarm is not None:
        raise typer.Exit(1)


def _watched(watcher: Watcher, logs: Iterator[ReadLog], update: Update) -> tuple[ReadLog, Alarm | None]:
    """Compare the steps of a log, and of the same log again after it has grown, up to a drift or its end."""
    from surrogym_trainer.watching.logs import steps_after
    from surrogym_trainer.watching.watcher import BATCH

    line = 0
    for read in logs:
        steps = steps_after(read, line)
        for first in range(0, len(steps), BATCH):
            batch = steps[first : first + BATCH]
            if (alarm := watcher.take(batch)) is not None:
                return read, alarm
            line = batch[-1].number
            update(None, f"{watcher.compared} real steps, no drift")
    return read, None


def _of_log(read: ReadLog) -> dict[str, Any]:
    return {
        "rows": len(read.table),
        "without_next_state": read.steps.ends,
        "rejected": [{"line": line, "reason": reason} for line, reason in read.rejected],
        "interval": read.steps.interval,
        "notes": list(read.notes),
    }


def _words(log: Path, read: ReadLog, watcher: Watcher, alarm: Alarm | None, named: str) -> list[str]:
    from surrogym_shared.words import counted, has

    lines = [f"{log}: {counted(len(read.table), 'row')}, {counted(len(read.steps), 'step')}", *read.notes]
    if read.steps.ends:
        lines.append(f"{has(read.steps.ends, 'row')} no next state, at the end of an episode or before a gap")
    if read.rejected:
        lines.append(f"{counted(len(read.rejected), 'row')} can't be compared:")
        lines += [f"  line {line}: {reason}" for line, reason in read.rejected[:SHOWN]]
    if watcher.left_out:
        lines.append(f"{counted(watcher.left_out, 'step')} left out, in which a constant changed or a lag is not known")
    if alarm is None:
        return [*lines, f"no drift in {counted(watcher.compared, 'real step')}"]
    return [
        *lines,
        f"drift, found in line {alarm.line} after {counted(alarm.compared, 'real step')}: {alarm.words()}",
        f"{named} is not trusted from now on; next: surrogym policy show {named}",
    ]
