"""``surrogym change``: change a design's budget, target or tolerances, or pause it."""

from __future__ import annotations

from typing import Annotated

import typer

from surrogym.cli.groups import Output, Service
from surrogym.cli.options import (
    Surrogate,
    Tolerances,
    read_tolerances,
)

USUAL = "=usual"  # --tolerance OUTPUT=usual gives an output its default tolerance again


def command(
    context: typer.Context,
    surrogate: Surrogate,
    tolerance: Tolerances = None,
    budget: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Maximum number of real steps that the design may take; 0 if all samples come from a log. [default: "
            "unchanged]",
        ),
    ] = None,
    target: Annotated[
        float | None, typer.Option(help="Confidence index to reach, between 0.5 and 1. [default: unchanged]")
    ] = None,
    paused: Annotated[
        bool | None,
        typer.Option(
            "--pause/--resume",
            help="Stop choosing queries, or continue. --resume also retries queries that were set aside. [default: "
            "unchanged]",
        ),
    ] = None,
    *,
    service: Service,
    output: Output,
) -> None:
    """Change or pause a surrogate's design.

    Options that are not given stay as they are. The server judges the model again with the new values. Queries that no
    sampler has begun are withdrawn and chosen anew. --resume also retries queries that were set aside because they kept
    failing, and restarts a failed design. --tolerance OUTPUT=usual returns an output to its default tolerance.

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
