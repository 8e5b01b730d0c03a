"""``surrogym reproduce paper``: section 5 of the paper, its figures 5 to 15, and its numbers beside ours."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from surrogym_client.cli.options import AsJson, Quiet


def register(app: typer.Typer) -> None:
    """Add ``surrogym reproduce paper`` to the app."""
    app.command("paper")(command)


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
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Run the experiments of section 5 of the paper.

    The folder --out gets results.md, results.csv, rows.json and figure05.png to figure15.png.

    Example: surrogym reproduce paper --out runs/paper

    Example: surrogym reproduce paper --quick --tasks cartpole --seeds 1
    """
    from dataclasses import replace

    from surrogym_client.cli.columns import columns
    from surrogym_client.cli.errors import CommandError
    from surrogym_client.experiments.reproduce.paper import run_cells, tables
    from surrogym_client.experiments.reproduce.paper_cases import QUICK, TASKS, WHOLE, cells
    from surrogym_shared.terminal import give, on_interrupt, progress

    chosen = tasks.split(",")
    if unknown := [name for name in chosen if name not in TASKS]:
        raise CommandError(f"unknown task {unknown[0]!r}: expected some of {', '.join(TASKS)}")
    scale = QUICK if quick else WHOLE
    scale = scale if steps is None else replace(scale, steps=steps)
    stays = f"interrupted; intermediate results are kept in {out}; the same command continues from there"
    with on_interrupt(lambda: stays), progress("reproduce", quiet=quiet) as update:
        rows = run_cells(list(cells(chosen, seeds, scale)), out, update)
        update(1.0, f"{len(rows)} cells")
    shown = tables(rows)
    result = {"out": str(out), "tables": shown}
    give(result, lambda: "\n\n".join(columns(lines) for lines in shown.values()), as_json=as_json, quiet=quiet)
