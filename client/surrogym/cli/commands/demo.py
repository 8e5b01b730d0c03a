"""``surrogym demo``: run the whole method on one machine, as three processes that talk over HTTP."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from surrogym.cli.errors import CommandError
from surrogym.cli.options import ExitWithParent, Quiet, require_known
from surrogym.demo.tasks import TASKS
from surrogym_client.runtime.lifetime import exit_with_parent as watch_parent
from surrogym_shared.kinds import Access
from surrogym_shared.terminal import give

if TYPE_CHECKING:
    from surrogym.demo.learning import SurrogateRun
    from surrogym.demo.settings import DemoSettings

    Task = str
else:
    Task = Literal[tuple(TASKS)]


RunFolder = Annotated[
    Path | None, typer.Option(help="Folder for the results of the run. [default: runs/TASK-seedSEED-TIME]")
]
Budget = Annotated[int | None, typer.Option(min=2, help="Maximum number of real steps. [default: from the task]")]
Steps = Annotated[int | None, typer.Option(min=1, help="Virtual steps of the training. [default: from the task]")]
Algorithm = Annotated[
    str | None,
    typer.Option(
        help="Policy search, as in surrogym train. [default: fastppo]",
        show_default=False,
    ),
]
AccessOption = Annotated[Access, typer.Option(help="Where a query may begin, as in surrogym register.")]


def command(
    task: Annotated[Task, typer.Argument(help="Task to solve.")] = "pendulum",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the design, the policy and the virtual environment.")] = 0,
    json_file: Annotated[
        Path | None,
        typer.Option("--json", help="Write the metrics to this file as well. With -, print them instead of the table."),
    ] = None,
    out: RunFolder = None,
    budget: Budget = None,
    steps: Steps = None,
    algorithm: Algorithm = None,
    access: AccessOption = "any",
    episodes: Annotated[int, typer.Option(min=1, help="Number of real episodes of the evaluation.")] = 100,
    pictures: Annotated[bool, typer.Option(help="Draw pictures of the run.")] = True,
    keep: Annotated[bool, typer.Option("--keep", help="Keep the server running until Ctrl-C.")] = False,
    exit_with_parent: ExitWithParent = False,
    quiet: Quiet = False,
) -> None:
    """Solve a task from a few real steps, on this machine.

    The command starts a server, a sampler and a trainer, evaluates the policy, and prints a table of the results.

    Example: surrogym demo pendulum --seed 0 --json metrics.json
    """
    from surrogym.demo.learning import SurrogateRun
    from surrogym.demo.settings import DemoSettings

    settings = DemoSettings(
        task=task,
        seed=seed,
        budget=budget,
        steps=steps,
        algorithm=algorithm,
        access=access,
        episodes=episodes,
        pictures=pictures,
        keep=keep,
    )
    perform(settings, SurrogateRun, out, json_file, exit_with_parent=exit_with_parent, quiet=quiet)


def perform(
    settings: DemoSettings,
    begin: Callable[..., SurrogateRun],
    out: Path | None,
    json_file: Path | None,
    *,
    exit_with_parent: bool,
    quiet: bool,
) -> None:
    """Run a demo, and show its metrics as a table, or write them to a file.

    Args:
        settings: settings of the demo.
        begin: starts the run that learns the policy.
        out: empty folder for the results; None makes one.
        json_file: file for the metrics; ``-`` prints them as JSON in place of the table; None writes none.
        exit_with_parent: whether to end with the process that started this one.
        quiet: whether progress and table are hidden.

    Raises:
        CommandError: the folder of ``json_file`` does not exist; nothing was run.
    """
    from surrogym.demo.report import table
    from surrogym.demo.run import run_demo

    if exit_with_parent:
        watch_parent()
    if settings.algorithm is not None:
        require_known(settings.algorithm)
    if json_file is not None and not json_file.resolve().parent.is_dir():
        raise CommandError(f"expected an existing folder for --json, got {json_file.parent}: make it first")
    as_json = json_file == Path("-")

    def tell(metrics: dict[str, Any], folder: Path) -> None:
        if json_file is not None and not as_json:
            json_file.write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
        give(metrics, lambda: table(metrics, folder), as_json=as_json, quiet=quiet)

    run_demo(settings, begin, out, tell, quiet=quiet)
