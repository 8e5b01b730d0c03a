"""``python -m surrogym_lab paper``: section 5 of the paper, its figures 5 to 15, and its numbers beside ours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from surrogym.cli.groups import add
from surrogym.cli.options import AsJson, Quiet
from surrogym_lab.commands.efficiency import OnRay

if TYPE_CHECKING:
    from surrogym_lab.reproduce.paper_cases import Cell


def register(app: typer.Typer) -> None:
    """Add ``python -m surrogym_lab paper`` to the app."""
    add(app, "paper", command)


def command(
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for intermediate results, table and pictures. The same command continues an interrupted run."
        ),
    ] = Path("runs/paper"),
    tasks: Annotated[str, typer.Option(help="Tasks, separated by commas: pendulum, cartpole.")] = "pendulum,cartpole",
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds, from 0 on.")] = 5,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Virtual steps of each training. [default: from the specification]")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Run a minimal form of everything, to check that it works.")
    ] = False,
    jobs: Annotated[
        int, typer.Option(min=1, help="Number of runs at once in a Ray cluster. Here they take turns.")
    ] = 1,
    on_ray: OnRay = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Run the experiments of section 5 of the paper.

    The folder --out gets results.md, results.csv, rows.json and figure05.png to figure15.png.

    Example: python -m surrogym_lab paper --out runs/paper

    Example: python -m surrogym_lab paper --on-ray auto --jobs 35

    Example: python -m surrogym_lab paper --quick --tasks cartpole --seeds 1
    """
    from dataclasses import replace

    from surrogym.cli.columns import columns
    from surrogym.cli.errors import CommandError
    from surrogym_client.runtime.lifetime import terminations_as_interrupts
    from surrogym_lab.reproduce.paper import tables
    from surrogym_lab.reproduce.paper_cases import QUICK, TASKS, WHOLE, cells
    from surrogym_shared.terminal import give, on_interrupt, progress

    chosen = tasks.split(",")
    if unknown := [name for name in chosen if name not in TASKS]:
        raise CommandError(f"unknown task {unknown[0]!r}: expected some of {', '.join(TASKS)}")
    if jobs > 1 and on_ray is None:
        raise CommandError(f"--jobs: expected --on-ray ADDRESS with more than 1, got {jobs} without it")
    scale = QUICK if quick else WHOLE
    scale = scale if steps is None else replace(scale, steps=steps)
    wanted = list(cells(chosen, seeds, scale))
    stays = f"interrupted; intermediate results are kept in {out}; the same command continues from there"
    with terminations_as_interrupts(), on_interrupt(lambda: stays), progress("reproduce", quiet=quiet) as update:
        rows, failed = _run(wanted, out, jobs, on_ray, update)
        update(1.0, f"{len(rows)} cells")
    shown = tables(rows)
    result = {"out": str(out), "tables": shown}
    give(result, lambda: "\n\n".join(columns(lines) for lines in shown.values()), as_json=as_json, quiet=quiet)
    if failed:
        raise CommandError(f"{len(failed)} of {len(wanted)} runs failed, the first: {failed[0]}")


def _run(
    wanted: Sequence[Cell], out: Path, jobs: int, on_ray: str | None, say: Callable[[float, str], None]
) -> tuple[list[dict[str, Any]], list[str]]:
    """Rows of the complete seeds, and a line for each run that failed."""
    from surrogym_client.runtime.ray_cluster import connect
    from surrogym_lab.reproduce.paper import run_cells, run_on_ray

    if on_ray is None:
        return run_cells(wanted, out, say), []
    connect(on_ray)
    return run_on_ray(wanted, out, jobs, say)
