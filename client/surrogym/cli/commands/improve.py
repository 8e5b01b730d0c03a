"""``surrogym improve``: add real steps to a surrogate's design."""

from __future__ import annotations

from typing import Annotated

import typer

from surrogym.cli.groups import Output, Service
from surrogym.cli.options import Surrogate


def command(
    context: typer.Context,
    surrogate: Surrogate,
    queries: Annotated[int, typer.Option("--queries", "-n", min=1, help="Number of real steps to add.")] = 10,
    checkpoint: Annotated[
        str | None,
        typer.Option(
            help="Name of a stored set of states that a policy visited. The queries are chosen near them. [default: "
            "the latest set, if any]"
        ),
    ] = None,
    *,
    service: Service,
    output: Output,
) -> None:
    """Add queries to a surrogate's design.

    A sampler has to take their real steps. The budget must have enough steps left. With an admin's token, or on a
    server without tokens, the budget is raised as needed.

    Example: surrogym improve pendulum --queries 10
    """

    with service.connect(context) as api:
        view = api.improve(surrogate, queries, checkpoint=checkpoint)
    raised = f"was raised by {view.budget_raised_by} to {view.budget}" if view.budget_raised_by else "holds them"
    words = f"{queries} more queries for {view.name}; its budget {raised}, with {view.budget_left} left"
    output.give(view.model_dump(mode="json"), lambda: words)
