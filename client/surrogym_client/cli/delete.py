"""``surrogym delete``: remove a surrogate with all its samples."""

from __future__ import annotations

from typing import Annotated

import typer

from surrogym_client.cli.options import AsJson, Quiet, Server, Surrogate, Token, TokenFile, connect, token_from


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("delete")(command)


def command(
    context: typer.Context,
    surrogate: Surrogate,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    server: Server = None,
    token: Token = None,
    token_file: TokenFile = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Delete a surrogate. Its samples, models and sessions are gone for good.

    Example: surrogym delete pendulum --yes
    """
    from surrogym_shared.terminal import give

    with connect(server, token_from(context, token, token_file)) as api:
        view = api.surrogate(surrogate)
        if not yes:
            typer.confirm(f"Delete {surrogate!r} with its {view.samples} real samples?", abort=True, err=True)
        api.delete_surrogate(surrogate)
    give({"deleted": surrogate}, lambda: f"{surrogate} deleted", as_json=as_json, quiet=quiet)
