"""``surrogym reproduce trust``: whether policies that are handed over as trusted keep their promise."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from surrogym_client.cli.options import AsJson, Quiet


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("trust")(command)


def command(
    tasks: Annotated[
        str, typer.Option(help="Tasks with commas between: unseen, those of the demo as well, or all of both.")
    ] = "unseen",
    seeds: Annotated[int, typer.Option(min=1, help="How many seeds.")] = 5,
    first_seed: Annotated[int, typer.Option(min=0, help="The first of them.")] = 2000,
    jobs: Annotated[int, typer.Option(min=1, help="Runs at once; each takes about one core.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder of rows, tables, pictures, logs and runs.")] = Path("runs/trust"),
    again: Annotated[bool, typer.Option("--again", help="Run also what has a row already.")] = False,
    episodes: Annotated[int, typer.Option(min=1, help="Real episodes of each evaluation.")] = 100,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Run the demo on ten tasks that the method was not made on. rows.csv, efficiency.md and pictures go into a folder.

    The table counts trusted runs whose real mean return is at least their promise's 5 % quantile. A run that has its
    row in rows.csv is not repeated, so that the same command goes on after Ctrl-C.

    Example: surrogym reproduce trust --seeds 5 --jobs 2

    Example: surrogym reproduce trust --tasks pendulum,cartpole --seeds 10 --first-seed 3000 --out runs/trust
    """
    from surrogym_client.cli.reproduce.efficiency import names_of, run_study
    from surrogym_client.experiments.reproduce.cells import cells
    from surrogym_client.experiments.tasks import EVERY_TASK, UNSEEN

    named = list(UNSEEN) if tasks == "unseen" else names_of("task", tasks, EVERY_TASK, "unseen")
    numbers = range(first_seed, first_seed + seeds)
    wanted = list(cells(named, ["default"], numbers, episodes=episodes))
    run_study(wanted, out, jobs, again=again, as_json=as_json, quiet=quiet)
