"""``surrogym describe``: draft the specification of an environment that has a name."""

from __future__ import annotations

from typing import Annotated

import typer

from surrogym.cli.options import Quiet
from surrogym.cli.printing import prints_aside, unregistered
from surrogym_shared.terminal import say


def command(
    environment: Annotated[
        str,
        typer.Argument(
            help="Environment: a Gymnasium id, package:Id-v0, dm_control:DOMAIN-TASK, pcgym:MODEL, pcgym:FILE.json, "
            "fmu:PLANT.fmu, fmu:PLANT.json or mujoco:FILE.xml."
        ),
    ],
    steps: Annotated[
        int, typer.Option(min=20, help="Real steps to take in random episodes. Some more real steps check the result.")
    ] = 400,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random actions.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="No effect: the output is always JSON.")] = False,
    quiet: Quiet = False,
) -> None:
    """Draft an environment's specification from random steps.

    The draft goes to standard output. Its notes say what the steps showed, and ask for what they can't show. The
    command prints the number of real steps. surrogym register reports them to the server, if it gets this file.

    Example: surrogym describe Swimmer-v5 > env.json
    """
    del as_json  # the output is JSON with and without --json
    with unregistered(lambda: 0, "nothing was described or registered"), prints_aside():
        from surrogym_sampler.original.describing import describe  # this import may take seconds

        description = describe(environment, steps, seed)
    typer.echo(description.text())
    for line in description.words():
        say(line, quiet=quiet)
