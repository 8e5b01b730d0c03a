"""``surrogym reproduce efficiency``: real steps against real return, over tasks, arms and seeds."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from surrogym_client.cli.options import AsJson, Quiet


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("efficiency")(command)


def command(
    tasks: Annotated[str, typer.Option(help="Tasks of the demo, with commas between.")] = "pendulum,cartpole",
    arms: Annotated[str, typer.Option(help="default, paper, with commas between.")] = "default",
    seeds: Annotated[int, typer.Option(min=1, help="How many seeds, from 0 on.")] = 3,
    out: Annotated[Path, typer.Option(help="Folder of the cells and the table; a run goes on where it ended.")] = Path(
        "runs/efficiency"
    ),
    steps: Annotated[int | None, typer.Option(min=1, help="Virtual steps of each training.")] = None,
    episodes: Annotated[int, typer.Option(min=1, help="Real episodes of each evaluation.")] = 100,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Run the demo over tasks, arms and seeds, and put results.csv and results.md into a folder.

    Example: surrogym reproduce efficiency --tasks pendulum,cartpole --seeds 3 --out runs/efficiency
    """
    from surrogym_client.cli.errors import CommandError
    from surrogym_client.cli.output import columns, give, progress
    from surrogym_client.demo.run import TASKS
    from surrogym_client.reproduce.efficiency import ARMS, Cell, cells, run_cells, summaries

    for what, given, known in (("task", tasks, TASKS), ("arm", arms, ARMS)):
        if unknown := [name for name in given.split(",") if name not in known]:
            raise CommandError(f"unknown {what} {unknown[0]!r}: expected some of {', '.join(known)}")
    options = ["--episodes", str(episodes), *([] if steps is None else ["--steps", str(steps)])]
    todo = list(cells(tasks.split(","), arms.split(","), seeds, options))
    with progress("reproduce", quiet=quiet) as update:

        def report(number: int, cell: Cell) -> None:
            update(number / len(todo), f"cell {number + 1} of {len(todo)}: {cell.name}")

        table = summaries(run_cells(todo, out, report))
        update(1.0, f"{len(todo)} cells")
    rows = [list(asdict(summary).values()) for summary in table]
    heading = list(asdict(table[0]))
    result = {"out": str(out), "rows": [asdict(summary) for summary in table]}
    give(result, lambda: columns([heading, *rows]), as_json=as_json, quiet=quiet)
