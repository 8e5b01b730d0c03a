"""``python -m surrogym_lab peers``: learning curves of other methods beside ours, on the same tasks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surrogym.cli.groups import add
from surrogym.cli.options import AsJson, Quiet
from surrogym_lab.commands.efficiency import OnRay

if TYPE_CHECKING:
    from surrogym_lab.peers.points import Point
    from surrogym_lab.peers.processes import AfterRound
    from surrogym_lab.peers.study import PeerCell

    Tell = Callable[[PeerCell, list[Point]], None]


def register(app: typer.Typer) -> None:
    """Add ``python -m surrogym_lab peers`` to the app."""
    add(app, "peers", command)


def command(
    tasks: Annotated[
        str, typer.Option(help="Tasks of the demo or package.module:Class, separated by commas, or core.")
    ] = "core",
    methods: Annotated[str, typer.Option(help="Methods, separated by commas, or all.")] = "all",
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds.")] = 5,
    first_seed: Annotated[int, typer.Option(min=0, help="First seed. The others follow it.")] = 0,
    jobs: Annotated[int, typer.Option(min=1, help="Number of runs at once. Each takes one core.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for points, table, pictures and runs.")] = Path("runs/peers"),
    rows: Annotated[
        list[Path] | None,
        typer.Option(help="File of rows with runs of ours. May be given several times. Only its tasks and arms count."),
    ] = None,
    budget: Annotated[
        int | None, typer.Option(min=1, help="Real steps of each peer. [default: from the method]")
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(min=1, help="Real episodes of each evaluation. [default: from the method]")
    ] = None,
    minutes: Annotated[float, typer.Option(min=0.01, help="Processor minutes of learning for each run.")] = 90.0,
    only_table: Annotated[bool, typer.Option("--only-table", help="Run nothing; show what there is.")] = False,
    on_ray: OnRay = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Run other methods on our tasks, and draw learning curves.

    The folder --out gets points.csv, peers.md and a picture of all tasks. A finished run is not repeated, so the same
    command continues after Ctrl-C. Runs with other settings need another --out. lab/records/results/peers.md has the
    rules. The methods default and latin_hypercube are ours; their runs come from files of rows, which python -m
    surrogym_lab efficiency writes.

    Example: python -m surrogym_lab peers --tasks pendulum --methods sac,ppo --seeds 3

    Example: python -m surrogym_lab peers --seeds 5 --on-ray auto --jobs 64

    Example: python -m surrogym_lab peers --rows lab/records/results/efficiency.csv --out runs/peers --only-table
    """
    from surrogym.cli.errors import CommandError
    from surrogym_lab.peers.study import PeerCell
    from surrogym_shared.terminal import say

    named, chosen = _tasks(tasks), _methods(methods)
    numbers = range(first_seed, first_seed + seeds)
    wanted = [PeerCell(t, m, s, budget, episodes, minutes) for s in numbers for t in named for m in chosen]
    ours = _ours(rows or [], named)
    if not only_table:
        if on_ray is None:
            _require_classes(named)
        _keep_others(wanted, out)
        todo = [cell for cell in wanted if not cell.done(out)]
        say(f"{len(wanted)} runs, {len(wanted) - len(todo)} of them done already", quiet=quiet)
        _run(todo if on_ray else _learnable(todo, quiet=quiet), out, jobs, on_ray, quiet=quiet)
    _present(wanted, ours, out, as_json=as_json, quiet=quiet)
    if not (only_table or any(cell.done(out) for cell in wanted)):
        raise CommandError(f"none of {len(wanted)} runs came to its end; the reasons are above and in {out / 'cells'}")


def _tasks(given: str) -> list[str]:
    from surrogym.cli.errors import CommandError
    from surrogym_lab.peers.registry import CORE, task_of

    names = list(CORE) if given == "core" else list(dict.fromkeys(given.split(",")))
    for name in names:
        try:
            task_of(name)
        except KeyError as error:
            raise CommandError(
                f"unknown task {name!r}: expected core, a task of the demo with its own specification, "
                "or package.module:Class"
            ) from error
    return names


def _require_classes(tasks: Sequence[str]) -> None:
    """Refuse a class that this machine does not have. Machines of a cluster may have others."""
    from surrogym_lab.peers.registry import task_of
    from surrogym_sampler.original.executables import is_executable
    from surrogym_sampler.original.factories import load_factory
    from surrogym_sampler.original.loading import is_own

    for environment in (task_of(name).environment for name in tasks):
        if is_own(environment) and not is_executable(environment):
            load_factory(environment)


def _methods(given: str) -> list[str]:
    from surrogym.cli.errors import CommandError
    from surrogym_lab.commands.efficiency import names_of
    from surrogym_lab.peers.registry import METHODS, OURS

    if ours := [name for name in given.split(",") if name in OURS]:
        raise CommandError(
            f"{ours[0]} is ours, and --methods takes peers: give --rows FILE, which has its runs; "
            f"python -m surrogym_lab efficiency --arms {ours[0]} writes one"
        )
    return names_of("method", given, METHODS)


def _keep_others(cells: Sequence[PeerCell], out: Path) -> None:
    """Refuse to overwrite runs with other settings."""
    from surrogym.cli.errors import CommandError

    if occupied := [cell.file(out) for cell in cells if cell.occupied(out)]:
        more = f" ({len(occupied)} such files)" if len(occupied) > 1 else ""
        raise CommandError(
            f"{occupied[0]} holds a run with other settings, such as --budget, --episodes or --minutes{more}; nothing "
            "was run: give another --out, or move the file away"
        )


def _learnable(cells: Sequence[PeerCell], *, quiet: bool) -> list[PeerCell]:
    """The cells whose method may learn their task. Says which others are left out, and why.

    Raises:
        CommandError: none is left.
    """
    from surrogym.cli.errors import CommandError
    from surrogym_lab.peers.study import refusals
    from surrogym_shared.terminal import say

    refused = refusals(cells)
    words = [f"{method} can't learn {task}: {reason}" for (task, method), reason in refused.items()]
    left = [cell for cell in cells if (cell.task, cell.method) not in refused]
    if words and not left:
        raise CommandError("; ".join(words))
    for line in words:
        say(f"{line}; left out", quiet=quiet)
    return left


def _run(todo: Sequence[PeerCell], out: Path, jobs: int, on_ray: str | None, *, quiet: bool) -> None:
    from surrogym_client.runtime.lifetime import terminations_as_interrupts
    from surrogym_shared.terminal import on_interrupt, progress, say

    jobs = min(jobs, len(todo))
    stays = f"interrupted; finished runs are kept in {out / 'cells'}; the same command continues from there"
    with terminations_as_interrupts(), on_interrupt(lambda: stays), progress("peers", quiet=quiet) as update:
        done = 0

        def tell(cell: PeerCell, points: Sequence[Point]) -> None:
            nonlocal done
            done += 1
            last = points[-1]
            update(done / len(todo), f"{done} of {len(todo)} runs")
            say(f"{_told(cell, last)}, {last.ended}", quiet=quiet)

        def after_round(cell: PeerCell, point: Point) -> None:
            update(done / len(todo), f"{done} of {len(todo)} runs; {_told(cell, point)}, round {point.round}")

        if todo:
            update(0.0, f"0 of {len(todo)} runs, {jobs} at once; the first round of a run may take minutes")
            _runner(on_ray, after_round)(todo, out, jobs, tell)


def _told(cell: PeerCell, point: Point) -> str:
    earned = "no return" if point.mean is None else f"mean return {point.mean:.1f}"
    return f"{cell.task} {cell.method} seed {cell.seed}: {point.real_steps} real steps, {earned}"


def _runner(address: str | None, after_round: AfterRound) -> Callable[[Sequence[PeerCell], Path, int, Tell], None]:
    """What runs cells: here, or in the Ray cluster at an address, from which rounds come at the end of a cell."""
    if address is None:
        from surrogym_lab.peers.processes import run_cells

        return partial(run_cells, after_round=after_round)
    from surrogym_client.runtime.ray_cluster import connect
    from surrogym_lab.peers import on_ray

    connect(address)
    return on_ray.run_cells


def _ours(files: Sequence[Path], tasks: Sequence[str]) -> list[Point]:
    """Points of our arms at each task's budget."""
    from surrogym.cli.errors import CommandError
    from surrogym_lab.peers.points import points_of
    from surrogym_lab.peers.registry import OURS, task_of
    from surrogym_lab.reproduce.rows import merge, read_rows

    if missing := [path for path in files if not path.exists()]:
        raise CommandError(f"expected a file of rows, got {missing[0]}, which does not exist")
    rows = merge(*map(read_rows, files))
    return points_of(
        row for row in rows if row.task in tasks and row.arm in OURS and row.budget <= task_of(row.task).budget
    )


def _present(cells: Sequence[PeerCell], ours: Sequence[Point], out: Path, *, as_json: bool, quiet: bool) -> None:
    """Write points, table and pictures, and print the table."""
    from surrogym_lab.peers.pictures import draw_tasks
    from surrogym_lab.peers.points import Point
    from surrogym_lab.peers.table import NOTES, table, unfinished
    from surrogym_lab.reproduce.markdown import fitted
    from surrogym_lab.reproduce.rows import write_records
    from surrogym_shared.terminal import give

    points = [*ours, *(point for cell in cells for point in cell.points(out))]
    points.sort(key=lambda p: [cell.task for cell in cells].index(p.task))
    left = unfinished([(cell.task, cell.method, cell.seed) for cell in cells], points)
    text = "\n".join([table(points), NOTES, *([f"Not run or not finished: {', '.join(left)}.\n"] if left else [])])
    write_records(out / "points.csv", Point, points)
    (out / "peers.md").write_text(text, encoding="utf-8")
    pictures = draw_tasks(out, points)
    result = {
        "out": str(out),
        "points": [vars(p) for p in points],
        "unfinished": left,
        "pictures": [str(path) for path in pictures],
    }
    give(result, lambda: fitted(text), as_json=as_json, quiet=quiet)
