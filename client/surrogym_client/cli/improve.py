"""``surrogym improve``: spend more real steps on a surrogate."""

from __future__ import annotations

from typing import Annotated

import typer

from surrogym_client.cli.groups import Output, Service, add
from surrogym_client.cli.options import Surrogate


def register(app: typer.Typer) -> None:
    """Add the command."""
    add(app, "improve", command)


def command(
    context: typer.Context,
    surrogate: Surrogate,
    queries: Annotated[int, typer.Option("--queries", "-n", min=1, help="How many more real steps.")] = 10,
    checkpoint: Annotated[
        str | None, typer.Option(help="Weigh by the states that policies visited up to this checkpoint.")
    ] = None,
    *,
    service: Service,
    output: Output,
) -> None:
    """Ask the design for more queries. A sampler has to answer them.

    The budget has to hold them. With an admin's token, or on a server without tokens, it is raised to.

    Example: surrogym improve pendulum --queries 10
    """

    with service.connect(context) as api:
        view = api.improve(surrogate, queries, checkpoint=checkpoint)
    raised = f"was raised by {view.budget_raised_by} to {view.budget}" if view.budget_raised_by else "holds them"
    words = f"{queries} more queries for {view.name}; its budget {raised}, with {view.budget_left} left"
    output.give(view.model_dump(mode="json"), lambda: words)
