"""``surrogym improve``: spend more real steps on a surrogate."""

from __future__ import annotations

from typing import Annotated

import typer

from surrogym_client.cli.options import AsJson, Quiet, Server, Surrogate, Token, TokenFile, connect, token_from


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("improve")(command)


def command(
    context: typer.Context,
    surrogate: Surrogate,
    queries: Annotated[int, typer.Option("--queries", "-n", min=1, help="How many more real steps.")] = 10,
    checkpoint: Annotated[
        str | None, typer.Option(help="Weigh by the states that policies visited up to this checkpoint.")
    ] = None,
    server: Server = None,
    token: Token = None,
    token_file: TokenFile = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Ask the design for more queries. A sampler has to answer them.

    The budget has to hold them. With an admin's token, or on a server without tokens, it is raised to.

    Example: surrogym improve pendulum --queries 10
    """
    from surrogym_shared.terminal import give

    with connect(server, token_from(context, token, token_file)) as api:
        view = api.improve(surrogate, queries, checkpoint=checkpoint)
    raised = f"was raised by {view.budget_raised_by} to {view.budget}" if view.budget_raised_by else "holds them"
    words = f"{queries} more queries for {view.name}; its budget {raised}, with {view.budget_left} left"
    give(view.model_dump(mode="json"), lambda: words, as_json=as_json, quiet=quiet)
