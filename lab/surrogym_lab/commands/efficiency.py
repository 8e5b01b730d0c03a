"""``python -m surrogym_lab efficiency``: real steps against real return, over tasks, arms and seeds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from surrogym.cli.groups import add
from surrogym.cli.options import AsJson, Quiet, require_known

if TYPE_CHECKING:
    from surrogym_lab.reproduce.cells import Begin, Cell, Progress
    from surrogym_lab.reproduce.rows import Row


STUDY = "study"
OnRay = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Run in the Ray cluster at ADDRESS (auto or host:port). --jobs is then the number of runs in the cluster.",
    ),
]


def register(app: typer.Typer) -> None:
    """Add ``python -m surrogym_lab efficiency`` to the app."""
    add(app, "efficiency", command)


def command(
    tasks: Annotated[str, typer.Option(help="Tasks of the demo, separated by commas, or all.")] = "all",
    arms: Annotated[str, typer.Option(help="Arms, separated by commas, or all, or study.")] = "default",
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds.")] = 3,
    first_seed: Annotated[int, typer.Option(min=0, help="First seed. The others follow it.")] = 0,
    jobs: Annotated[int, typer.Option(min=1, help="Number of runs at once. Each takes about one core.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for rows, tables, pictures, logs and runs.")] = Path(
        "runs/efficiency"
    ),
    shares: Annotated[
        str, typer.Option(help="Shares of each task's budget, separated by commas. Each share is a run of its own.")
    ] = "1",
    again: Annotated[bool, typer.Option("--again", help="Repeat runs that have a row already.")] = False,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Virtual steps of each training. [default: from the task]")
    ] = None,
    episodes: Annotated[int, typer.Option(min=1, help="Number of real episodes of each evaluation.")] = 100,
    algorithm: Annotated[
        str | None, typer.Option(help="Policy search, as in surrogym demo. [default: that command's]")
    ] = None,
    on_ray: OnRay = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Run the demo over tasks, arms and seeds.

    The folder --out gets rows.csv, efficiency.md and a picture of each task. A run that has a row in rows.csv is not
    repeated, so the same command continues after Ctrl-C. An arm is a way to choose real steps: default, no_symmetry,
    declared_starts, no_loop, variance, latin_hypercube, paper, paper_hypercube or oracle;
    lab/records/results/efficiency.md explains each. --arms study runs default on every task, latin_hypercube and paper
    on four of them, and the other arms on the same four with half of the seeds.

    Example: python -m surrogym_lab efficiency --seeds 10 --jobs 2 --out runs/efficiency

    Example: python -m surrogym_lab efficiency --arms study --seeds 10 --jobs 2

    Example: python -m surrogym_lab efficiency --arms study --seeds 10 --on-ray auto --jobs 64

    Example: python -m surrogym_lab efficiency --tasks pendulum,acrobot --arms default,latin_hypercube --seeds 5
    """
    numbers = range(first_seed, first_seed + seeds)
    chosen = {"shares": _shares(shares), "steps": steps, "episodes": episodes, "algorithm": algorithm}
    run_study(_wanted(tasks, arms, numbers, chosen), out, jobs, on_ray, again=again, as_json=as_json, quiet=quiet)


def run_study(
    wanted: Sequence[Cell], out: Path, jobs: int, on_ray: str | None, *, again: bool, as_json: bool, quiet: bool
) -> None:
    """Run the cells that have no row yet, or all of them if ``again``, and show the table.

    Args:
        wanted: all cells of the study.
        out: its folder.
        jobs: cells at once.
        on_ray: address of a Ray cluster that runs them; None runs them here.

    Raises:
        CommandError: a run failed.
        NoCluster: there is no such cluster.
    """
    from surrogym.cli.errors import CommandError
    from surrogym_client.runtime.lifetime import terminations_as_interrupts
    from surrogym_lab.commands.table import present
    from surrogym_lab.reproduce.cells import done_already, run_cells
    from surrogym_lab.reproduce.rows import read_rows
    from surrogym_shared.terminal import on_interrupt, progress, say

    begin = _begin_on(on_ray)
    rows = read_rows(out / "rows.csv")
    todo = wanted if again else [cell for cell in wanted if not done_already(cell, rows)]
    say(f"{len(wanted)} runs, {len(wanted) - len(todo)} of them done already", quiet=quiet)
    stays = f"interrupted; finished runs are kept in {out / 'rows.csv'}; the same command continues from there"
    with terminations_as_interrupts(), on_interrupt(lambda: stays), progress("reproduce", quiet=quiet) as update:

        def tell(now: Progress) -> None:
            update(now.done / now.of, _words(now))
            if now.last is not None:
                say(_outcome(now.last), quiet=quiet)

        rows = run_cells(todo, rows, out, jobs, tell, begin=begin) if todo else rows
    present(rows, out, as_json=as_json, quiet=quiet)
    if bad := [row for row in rows if row.error and row.key in {cell.key for cell in wanted}]:
        raise CommandError(f"{len(bad)} runs failed, the first with {bad[0].error}; logs: {out / 'logs'}")


def _begin_on(address: str | None) -> Begin | None:
    if address is None:
        return None
    from surrogym_client.runtime.ray_cluster import connect
    from surrogym_lab.reproduce.on_ray import RayRun

    connect(address)
    return RayRun


def _wanted(tasks: str, arms: str, seeds: Sequence[int], chosen: dict[str, Any]) -> list[Cell]:
    """Return the runs of the chosen tasks and arms."""
    from surrogym.demo.tasks import TASKS
    from surrogym_lab.arms import ARMS
    from surrogym_lab.reproduce.cells import cells, study

    named = names_of("task", tasks, TASKS)
    if chosen["algorithm"] is not None:
        require_known(chosen["algorithm"])
    if arms == STUDY:
        return list(study(named, seeds, **chosen))
    return list(cells(named, names_of("arm", arms, ARMS, STUDY), seeds, **chosen))


def names_of(what: str, given: str, known: Iterable[str], *words: str) -> list[str]:
    """Split names that are separated by commas; ``all`` means every known name.

    Raises:
        CommandError: a name is not known.
    """
    from surrogym.cli.errors import CommandError
    from surrogym_shared.removed import remark

    if given == "all":
        return list(known)
    names = list(dict.fromkeys(given.split(",")))
    if unknown := [name for name in names if name not in known]:
        raise CommandError(
            f"unknown {what} {unknown[0]!r}: expected {', '.join(('all', *words))}, or some of {', '.join(known)}"
            f"{remark(what, unknown[0])}"
        )
    return names


def _shares(given: str) -> list[float]:
    from surrogym.cli.errors import CommandError

    try:
        shares = [float(share) for share in given.split(",")]
    except ValueError as error:
        raise CommandError(f"--shares: expected numbers separated by commas, got {given!r}") from error
    if not all(0 < share <= 10 for share in shares):
        raise CommandError(f"--shares: expected numbers above 0 and up to 10, got {given!r}")
    return shares


def _words(now: Progress) -> str:
    left = "" if now.left_seconds is None else f", about {now.left_seconds / 60:.0f} min left"
    return f"{now.done} of {now.of} runs{left}; running: {', '.join(now.running) or '-'}"


def _outcome(row: Row) -> str:
    name = f"{row.task} {row.arm} seed {row.seed}"
    if row.error or row.mean is None or row.seconds is None:
        return f"{name}: failed, {row.error}"
    reached = "reached" if row.reached else "not reached"
    return f"{name}: {row.real_steps} real steps, mean return {row.mean:.1f}, target {reached}, {row.seconds:.0f} s"
