"""``python -m surrogym_lab trust``: count how often trusted policies keep their promise."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from surrogym.cli.groups import add
from surrogym.cli.options import AsJson, Quiet
from surrogym_lab.commands.efficiency import OnRay


def register(app: typer.Typer) -> None:
    """Add ``python -m surrogym_lab trust`` to the app."""
    add(app, "trust", command)


def command(
    tasks: Annotated[
        str, typer.Option(help="Tasks, separated by commas: unseen, tasks of the demo, or all.")
    ] = "unseen",
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds.")] = 5,
    first_seed: Annotated[int, typer.Option(min=0, help="First seed. The others follow it.")] = 2000,
    jobs: Annotated[int, typer.Option(min=1, help="Number of runs at once. Each takes about one core.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for rows, tables, pictures, logs and runs.")] = Path("runs/trust"),
    again: Annotated[bool, typer.Option("--again", help="Repeat runs that have a row already.")] = False,
    episodes: Annotated[int, typer.Option(min=1, help="Number of real episodes of each evaluation.")] = 100,
    on_ray: OnRay = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Count how often trusted policies keep their promise.

    The command runs the demo on ten tasks that were not used to develop the method. A promise is kept if the real mean
    return is at least the promise's 5 % quantile. The folder --out gets rows.csv, efficiency.md and pictures. A run
    that has a row in rows.csv is not repeated, so the same command continues after Ctrl-C.

    Example: python -m surrogym_lab trust --seeds 5 --jobs 2

    Example: python -m surrogym_lab trust --tasks pendulum,cartpole --seeds 10 --first-seed 3000 --out runs/trust
    """
    from surrogym_lab.commands.efficiency import names_of, run_study
    from surrogym_lab.reproduce.cells import cells
    from surrogym_lab.tasks import EVERY_TASK, UNSEEN

    named = list(UNSEEN) if tasks == "unseen" else names_of("task", tasks, EVERY_TASK, "unseen")
    numbers = range(first_seed, first_seed + seeds)
    wanted = list(cells(named, ["default"], numbers, episodes=episodes))
    run_study(wanted, out, jobs, on_ray, again=again, as_json=as_json, quiet=quiet)
