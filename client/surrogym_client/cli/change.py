"""``surrogym change``: pause or resume a design, or ask more or less of it."""

from __future__ import annotations

from typing import Annotated

import typer

from surrogym_client.cli.options import (
    AsJson,
    Quiet,
    Server,
    Surrogate,
    Token,
    TokenFile,
    Tolerances,
    connect,
    read_tolerances,
    token_from,
)

USUAL = "=usual"  # takes a tolerance back


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("change")(command)


def command(
    context: typer.Context,
    surrogate: Surrogate,
    tolerance: Tolerances = None,
    budget: Annotated[int | None, typer.Option(min=2, help="Real steps the design may take.")] = None,
    target: Annotated[float | None, typer.Option(help="Confidence index to reach.")] = None,
    paused: Annotated[bool | None, typer.Option("--pause/--resume", help="Stop asking for queries, or go on.")] = None,
    server: Server = None,
    token: Token = None,
    token_file: TokenFile = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Change a living surrogate. Its model is judged anew, and what is left out stays.

    Queries that the design had chosen before, and that no sampler has begun, are withdrawn and chosen anew.

    Example: surrogym change pendulum --tolerance theta=0.01 --budget 30

    Example: surrogym change pendulum --tolerance theta=usual
    """
    from surrogym_shared.terminal import give

    back = {text.removesuffix(USUAL): None for text in tolerance or () if text.endswith(USUAL)}
    tolerances = read_tolerances([text for text in tolerance or () if not text.endswith(USUAL)]) | back
    with connect(server, token_from(context, token, token_file)) as api:
        view = api.patch_surrogate(
            surrogate, paused=paused, budget=budget, target=target, tolerances=tolerances or None
        )
    set_by_hand = "".join(f", {name} to {value:g}" for name, value in view.tolerances.items())
    state = "paused" if view.paused else view.phase
    words = f"{view.name}: {state}, budget of {view.budget} real steps, target {view.target:g}{set_by_hand}"
    give(view.model_dump(mode="json"), lambda: words, as_json=as_json, quiet=quiet)
