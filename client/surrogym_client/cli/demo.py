"""``surrogym demo``: the whole loop on one machine, as three processes that talk over HTTP."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from surrogym_client.cli.options import Preset, Quiet

Task = Literal["pendulum", "cartpole", "mountaincar", "acrobot", "invertedpendulum", "reacher"]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("demo")(command)


def command(
    task: Annotated[Task, typer.Argument(help="What to solve.")] = "pendulum",
    seed: Annotated[int, typer.Option(min=0, help="Seed of design, policy and virtual environment.")] = 0,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the metrics to this file too; - is standard output.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Run folder. [default: runs/TASK-seedSEED-TIME]")] = None,
    budget: Annotated[int | None, typer.Option(min=2, help="Real steps of the design. [default: the task's]")] = None,
    preset: Annotated[Preset | None, typer.Option(help="default, or paper: the method as printed.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Virtual steps of the training.")] = None,
    episodes: Annotated[int, typer.Option(min=1, help="Real episodes of the evaluation.")] = 100,
    keep: Annotated[bool, typer.Option("--keep", help="Leave the server running until Ctrl-C.")] = False,
    quiet: Quiet = False,
) -> None:
    """Start a server, a sampler and a trainer, solve a task from a few real steps, and show what came of it.

    Example: surrogym demo pendulum --seed 0 --json metrics.json
    """
    from surrogym_client.cli.errors import CommandError
    from surrogym_client.demo.run import DemoSettings, run_demo

    if json_file is not None and not json_file.resolve().parent.is_dir():
        raise CommandError(f"expected an existing folder for --json, got {json_file.parent}")
    settings = DemoSettings(
        task=task, seed=seed, budget=budget, preset=preset, steps=steps, episodes=episodes, keep=keep
    )
    metrics = run_demo(settings, out, quiet=quiet or json_file == Path("-"))
    if json_file == Path("-"):
        typer.echo(json.dumps(metrics, indent=2))
    elif json_file is not None:
        json_file.write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
