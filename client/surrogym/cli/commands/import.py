"""``surrogym import``: make a surrogate from an exported file, or from a log of real steps."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from surrogym.cli.errors import CommandError
from surrogym.cli.groups import Output, Service
from surrogym.cli.options import SpecFile, Wait, await_model, connect, given_here, read_spec, typed, working
from surrogym_shared.words import counted, has

if TYPE_CHECKING:
    from surrogym_sampler.logs import Imported, ReadLog
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_shared.wire import SurrogateView

SHOWN = 5  # at most this number of rejected rows is printed; a file has all of them


@dataclass(frozen=True)
class OfLogs:
    """Options of importing a log."""

    register: Annotated[
        str | None,
        typer.Option(
            "--register", help="For a log: register a new surrogate of this name, with the drafted specification."
        ),
    ] = None
    to: Annotated[
        str | None,
        typer.Option(
            "--to", help="For a log: add its steps to this existing surrogate, whose specification is used to read it."
        ),
    ] = None
    mapping: Annotated[
        Path | None, typer.Option("--map", help="For a log: JSON or TOML file that says what each column means.")
    ] = None
    spec: SpecFile = None
    draft: Annotated[
        Path | None,
        typer.Option(
            "--draft", help="For a log: write the drafted specification to this file, so that you can edit it."
        ),
    ] = None
    budget: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="For a log: real steps that the design may take beyond the log; 0 if there is no machine to take "
            "them. [default: that of --spec, or 0]",
        ),
    ] = None
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture", help="For a log: draw its coverage of the sampling range to this file (.png, .svg or .pdf)."
        ),
    ] = None
    rejected: Annotated[
        Path | None,
        typer.Option(
            "--rejected",
            help="For a log: file for the rows that can't be used. [default: LOG.rejected.csv, beside the log]",
        ),
    ] = None


def command(
    context: typer.Context,
    file: Annotated[
        Path,
        typer.Argument(
            help="A .surrogate file from surrogym export; or a log as CSV, NPZ, Parquet or HDF5; or the name of a "
            "Minari data set."
        ),
    ],
    name: Annotated[
        str | None, typer.Option(help="For a .surrogate file: name of the new surrogate. [default: as in the file]")
    ] = None,
    *,
    log: OfLogs,
    wait: Wait = 0.0,
    service: Service,
    output: Output,
) -> None:
    """Make a surrogate from an exported file, or from a log.

    A .surrogate file: the server stores its real samples as manual ones, and serves the same model at once, with the
    same tolerances. The design is paused. surrogym change NAME --resume continues it, beginning with its initial
    queries.

    A log: the command checks each row, then drafts and shows a specification. Rows that can't be used go to
    LOG.rejected.csv, with line and reason. With --register or --to, the server stores the other rows and fits a model
    to them. They don't count towards the budget. Importing the same log again changes nothing.

    Example: surrogym import reactor.csv --register reactor --wait 120
    """
    from surrogym_sampler.logs.reading import format_of

    if format_of(file) == "surrogate":
        if given := [f"--{name}" for name, value in vars(log).items() if value is not None]:
            raise CommandError(
                f"{file} is a surrogate's file: leave out {given[0].replace('mapping', 'map')}, an option for logs"
            )
        _import_surrogate(context, file, name, service, output)
        return
    if name is not None:
        raise CommandError(f"{file} is a log: give --register NAME or --to NAME, not --name")
    if log.register and log.to:
        raise CommandError("expected --register or --to, got both; give one of the two")
    if log.to and log.spec:
        raise CommandError(
            "expected --spec without --to, whose surrogate has a specification, got both; leave out --spec"
        )
    if log.to and given_here(context, "budget"):
        raise CommandError(
            "expected --budget without --to, whose surrogate has a budget, got both: surrogym change "
            f"{shlex.quote(log.to)} --budget N changes it"
        )
    _require_outputs(file, log)
    _import_log(context, file, log, wait, service, output)


def _require_outputs(file: Path, log: OfLogs) -> None:
    """Raise ``UnusableLog`` if an output file is also an input file of the command, or can't be written."""
    from surrogym_sampler.logs.outputs import rejected_file, require_outputs, require_picture

    require_outputs(
        {"--rejected": log.rejected, "--draft": log.draft, "--picture": log.picture},
        {"the log": file, "--map": log.mapping, "--spec": log.spec},
        perhaps={"the rejected rows": rejected_file(file, None) if log.rejected is None else None},
    )
    if log.picture is not None:
        require_picture("--picture", log.picture)


def _import_surrogate(context: typer.Context, file: Path, name: str | None, service: Service, output: Output) -> None:
    from surrogym_client.surrogates.transfer import import_surrogate
    from surrogym_shared.surrogate_file import SurrogateFile

    token = service.token_for(context)
    stays = "interrupted; the server kept nothing of it; the same command starts from the beginning"
    with working("import", stays, quiet=output.quiet) as update, connect(service.server, token) as api:
        update(0.0, f"reading {file}")
        read = SurrogateFile.load(file)
        view = import_surrogate(api, read, name, lambda share: update(share, f"{len(read.samples)} real samples"))
    words = (
        f"{view.name}: {view.environment or 'own environment'}, model {view.model_version} and {view.samples} real "
        f"samples{_origin(read.ledger)}, design paused; next: surrogym train {view.name}"
    )
    output.give(view.model_dump(mode="json"), lambda: words)


def _import_log(context: typer.Context, file: Path, log: OfLogs, wait: float, service: Service, output: Output) -> None:
    from surrogym_sampler.logs import import_log

    token = service.token_for(context) if log.register or log.to else None
    stays = "interrupted; the steps stored so far are kept; the same command stores the others"
    with working("import", stays, quiet=output.quiet) as update:
        imported = import_log(
            file,
            register=log.register,
            to=log.to,
            mapping=log.mapping,
            spec=read_spec(log.spec),
            budget=log.budget,
            rejected=log.rejected,
            draft=log.draft,
            url=service.server,
            token=token,
            progress=update,
        )
    if log.picture is not None:
        _draw(imported.log, log.picture)
    view = None
    if imported.surrogate is not None and wait > 0:
        from surrogym_client.surrogates.waiting import words_of_long_fit

        view = await_model(service.server, token, imported.surrogate, wait, words_of_long_fit, quiet=output.quiet)
    following = _following(context, log, imported, view)
    output.give(_as_json(imported, view), lambda: "\n".join([*_words(file, imported, view), following]))


def _draw(log: ReadLog, file: Path) -> None:
    """Draw to a file how much of the sampling range a log covers."""
    from surrogym_trainer.coverage import coverage_of
    from surrogym_trainer.figures import draw_coverage

    draw_coverage(coverage_of(log.spec, log.steps.q, log.steps.u)).savefig(file, dpi=150)


def _following(context: typer.Context, log: OfLogs, imported: Imported, view: SurrogateView | None) -> str:
    """Return the last line of the command's output, which advises on the next step."""
    name = imported.surrogate
    unpaid = log.to is None and log.spec is None and imported.log.roles.reward is None
    if unpaid and log.draft is None:
        without = ["token", "as_json", "quiet", "register", "wait"]
        command = f"surrogym import {typed(context, without)} --draft spec.json"
        if name is None:
            return f"nothing was stored; the log has no reward, so declare it in the draft: {command}"
        return (
            f"{name} has a reward of 0, so there is nothing to train; declare the reward in a draft, and register it "
            f"under another name: {command}"
        )
    again = _again(context, log)
    if unpaid:
        stored = "nothing was stored" if name is None else f"{name} has a reward of 0, so there is nothing to train"
        return f"{stored}; next: declare the reward in {log.draft}, and then: {again}"
    if name is None:
        return f"nothing was stored; next: {again}"
    return f"next: surrogym train {name}" if view is not None else f"next: surrogym status {name}"


def _again(context: typer.Context, log: OfLogs) -> str:
    """Return the command line that imports the log again and stores it, with the drafted specification that the user
    may have edited."""
    without = ["token", "as_json", "quiet", "register", *(["draft"] if log.draft is not None else [])]
    drafted = "" if log.draft is None else f" --spec {shlex.quote(str(log.draft))}"
    if drafted:
        without.append("spec")
    return f"surrogym import {typed(context, without)}{drafted} --register NAME"


def _as_json(imported: Imported, view: SurrogateView | None) -> dict[str, Any]:
    log = imported.log
    return {
        "surrogate": imported.surrogate,
        "rows": len(log.table),
        "steps": len(log.steps),
        "sent": imported.sent,
        "duplicates": imported.duplicates,
        "without_next_state": log.steps.ends,
        "rejected": [{"line": line, "reason": reason} for line, reason in log.rejected],
        "rejected_file": None if imported.rejected_file is None else str(imported.rejected_file),
        "data_hash": log.steps.digest,
        "columns": log.roles.used,
        "ignored": log.ignored,
        "notes": list(log.notes),
        "coverage": _covered(log),
        "spec": log.spec.model_dump(mode="json"),
        "view": None if view is None else view.model_dump(mode="json"),
    }


def _covered(log: ReadLog) -> dict[str, float]:
    """Return how much of the sampling range a log covers, for each pair of coordinates or action entries: the share of
    the cells of a grid in which the log has steps."""
    from surrogym_trainer.coverage import coverage_of

    coverage = coverage_of(log.spec, log.steps.q, log.steps.u)
    return {" by ".join(coverage.names[i] for i in pair): coverage.share(pair) for pair in coverage.counts}


def _words(file: Path, imported: Imported, view: SurrogateView | None) -> list[str]:
    from surrogym_trainer.coverage import coverage_of

    log = imported.log
    lines = [f"{file}: {counted(len(log.table), 'row')}, {counted(len(log.steps), 'step')}"]
    if log.steps.ends:
        where = "it ends an episode, or stands" if log.steps.ends == 1 else "they end an episode, or stand"
        lines.append(f"{has(log.steps.ends, 'row')} no next state: {where} before a gap")
    covered = coverage_of(log.spec, log.steps.q, log.steps.u).words()
    lines += [*_columns(log), *_rejected(imported), *_specified(log.spec, log.notes), covered]
    name = imported.surrogate
    if name is None:
        return lines
    were = "was" if imported.duplicates == 1 else "were"
    there = f", {imported.duplicates} {were} there before" if imported.duplicates else ""
    lines.append(f"{name}: {counted(imported.taken, 'new logged step')}{there}")
    if imported.taken:
        lines.append(
            f"if a simulator made these rows, learn the machine beside them: surrogym prior MACHINE surrogate:{name}"
        )
    if view is not None and view.fidelity is not None:
        index = view.fidelity.confidence_index
        lines.append(f"model {view.model_version} of {counted(view.samples, 'step')}: confidence index {index:.4f}")
    return lines


def _columns(log: ReadLog) -> list[str]:
    used = [f"  {column}: {role}" for column, role in log.roles.used.items()]
    return ["columns:", *used, *(f"  {column}: ignored, as {reason}" for column, reason in log.ignored.items())]


def _rejected(imported: Imported) -> list[str]:
    rejected = imported.log.rejected
    if not rejected:
        return []
    lines = [f"{counted(len(rejected), 'row')} can't be used, see {imported.rejected_file}:"]
    lines += [f"  line {line}: {reason}" for line, reason in rejected[:SHOWN]]
    return [*lines, f"  and {len(rejected) - SHOWN} more"] if len(rejected) > SHOWN else lines


def _specified(spec: EnvironmentSpec, notes: tuple[str, ...]) -> list[str]:
    from surrogym_shared.logs.drafting import limited

    lines = [f"  {name}: {words}" for name, words in limited(spec).items()]
    return ["specification:", *lines, *(f"  {note}" for note in notes)]


def _origin(ledger: dict[str, int]) -> str:
    """Describe how many real steps the server that exported a file had counted, by purpose; empty if there are none."""
    steps = ", ".join(f"{count} {purpose}" for purpose, count in ledger.items() if count)
    return f" (there {steps})" if steps else ""
