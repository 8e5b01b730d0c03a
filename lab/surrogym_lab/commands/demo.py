"""``python -m surrogym_lab demo``: one run of a study, on any of its tasks and with any of its arms."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from surrogym.cli.commands.demo import Budget, RunFolder, Steps, perform
from surrogym.cli.groups import add
from surrogym.cli.options import ExitWithParent, Quiet
from surrogym_lab.arms import ARMS
from surrogym_lab.tasks import EVERY_TASK

if TYPE_CHECKING:
    Task = str
    ArmName = str
else:
    Task, ArmName = Literal[tuple(EVERY_TASK)], Literal[tuple(ARMS)]


Arm = Annotated[
    ArmName, typer.Option(help="Method to choose real steps by; lab/records/results/efficiency.md explains each.")
]
Algorithm = Annotated[
    str | None,
    typer.Option(
        help="Policy search, as in surrogym train. [default: fastppo; ppo with the paper's arms and oracle]",
        show_default=False,
    ),
]


def register(app: typer.Typer) -> None:
    """Add ``demo`` to the app."""
    add(app, "demo", command)


def command(
    task: Annotated[Task, typer.Argument(help="Task to solve.")] = "pendulum",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the design, the policy and the virtual environment.")] = 0,
    json_file: Annotated[
        Path | None,
        typer.Option("--json", help="Write the metrics to this file as well. With -, print them instead of the table."),
    ] = None,
    out: RunFolder = None,
    arm: Arm = "default",
    budget: Budget = None,
    steps: Steps = None,
    algorithm: Algorithm = None,
    episodes: Annotated[int, typer.Option(min=1, help="Number of real episodes of the evaluation.")] = 100,
    pictures: Annotated[bool, typer.Option(help="Draw pictures of the run.")] = True,
    exit_with_parent: ExitWithParent = False,
    quiet: Quiet = False,
) -> None:
    """Run one task with one arm, as surrogym demo does with its own.

    Example: python -m surrogym_lab demo pendulum --arm latin_hypercube --seed 0 --json metrics.json
    """
    from surrogym_lab.runs import begin
    from surrogym_lab.settings import StudySettings

    settings = StudySettings(
        task=task,
        seed=seed,
        budget=budget,
        steps=steps,
        algorithm=algorithm,
        episodes=episodes,
        pictures=pictures,
        arm=arm,
    )
    perform(settings, begin, out, json_file, exit_with_parent=exit_with_parent, quiet=quiet)
