"""``surrogym change``: pause or resume a design, or ask more or less of it."""

from __future__ import annotations

from typing import Annotated

import typer

from surrogym_client.cli.groups import Output, Service, add
from surrogym_client.cli.options import (
    Surrogate,
    Tolerances,
    read_tolerances,
)

USUAL = "=usual"  # takes a tolerance back


def register(app: typer.Typer) -> None:
    """Add the command."""
    add(app, "change", command)


def command(
    context: typer.Context,
    surrogate: Surrogate,
    tolerance: Tolerances = None,
    budget: Annotated[int | None, typer.Option(min=0, help="Real steps the design may take; 0 of a log.")] = None,
    target: Annotated[float | None, typer.Option(help="Confidence index to reach.")] = None,
    paused: Annotated[
        bool | None,
        typer.Option("--pause/--resume", help="Stop asking for queries, or go on, also with those set aside."),
    ] = None,
    *,
    service: Service,
    output: Output,
) -> None:
    """Change a living surrogate. Its model is judged anew, and what is left out stays.

    Queries that the design had chosen before, and that no sampler has begun, are withdrawn and chosen anew. --resume
    also asks again what was set aside as it kept failing, and takes up a design that has failed.

    Example: surrogym change pendulum --tolerance theta=0.01 --budget 30

    Example: surrogym change pendulum --tolerance theta=usual
    """

    back = {text.removesuffix(USUAL): None for text in tolerance or () if text.endswith(USUAL)}
    tolerances = read_tolerances([text for text in tolerance or () if not text.endswith(USUAL)]) | back
    with service.connect(context) as api:
        view = api.patch_surrogate(
            surrogate, paused=paused, budget=budget, target=target, tolerances=tolerances or None
        )
    set_by_hand = "".join(f", {name} to {value:g}" for name, value in view.tolerances.items())
    state = "paused" if view.paused else view.phase
    words = f"{view.name}: {state}, budget of {view.budget} real steps, target {view.target:g}{set_by_hand}"
    output.give(view.model_dump(mode="json"), lambda: words)
