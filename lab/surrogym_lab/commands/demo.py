"""``python -m surrogym_lab demo``: one run of a study, on any of its tasks and with any of its arms."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from surrogym_client.cli.groups import add
from surrogym_client.cli.options import ExitWithParent, Quiet, require_known
from surrogym_lab.arms import ARMS
from surrogym_lab.tasks import EVERY_TASK

if TYPE_CHECKING:
    Task = str
    ArmName = str
else:
    Task, ArmName = Literal[tuple(EVERY_TASK)], Literal[tuple(ARMS)]


RunFolder = Annotated[
    Path | None, typer.Option(help="Folder for the results of the run. [default: runs/TASK-seedSEED-TIME]")
]
Arm = Annotated[ArmName, typer.Option(help="Method to choose real steps by; docs/results/efficiency.md explains each.")]
Budget = Annotated[int | None, typer.Option(min=2, help="Maximum number of real steps. [default: from the task]")]
Steps = Annotated[int | None, typer.Option(min=1, help="Virtual steps of the training. [default: from the task]")]
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
    from surrogym_client.cli.errors import CommandError
    from surrogym_client.demo.report import table
    from surrogym_client.demo.run import run_demo
    from surrogym_client.runtime.lifetime import exit_with_parent as watch_parent
    from surrogym_lab.runs import begin
    from surrogym_lab.settings import StudySettings
    from surrogym_shared.terminal import give

    if exit_with_parent:
        watch_parent()

    if algorithm is not None:
        require_known(algorithm)
    if json_file is not None and not json_file.resolve().parent.is_dir():
        raise CommandError(f"expected an existing folder for --json, got {json_file.parent}")
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
    as_json = json_file == Path("-")

    def tell(metrics: dict[str, Any], folder: Path) -> None:
        if json_file is not None and not as_json:
            json_file.write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
        give(metrics, lambda: table(metrics, folder), as_json=as_json, quiet=quiet)

    run_demo(settings, out, tell, begin, quiet=quiet)
