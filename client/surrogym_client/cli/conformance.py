"""``surrogym conformance``: whether a server keeps the protocol."""

from __future__ import annotations

from typing import Annotated

import typer

from surrogym_client.cli.options import AsJson, Quiet, Server, Token, TokenFile, token_from


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("conformance")(command)


def command(
    context: typer.Context,
    server: Server = None,
    surrogate: Annotated[
        str, typer.Option("--surrogate", help="A free name; the surrogate is deleted at the end.")
    ] = "conformance",
    token: Token = None,
    token_file: TokenFile = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Check a server against the protocol. One line a check; exit status 1 where it fails one. With --quiet, failed
    checks alone are shown.

    Example: surrogym conformance --server http://127.0.0.1:8000
    """
    from surrogym_client.diagnosis.conformance import conformance
    from surrogym_shared.terminal import give, on_interrupt, visible

    outcomes = []
    with on_interrupt(lambda: f"interrupted; nothing stays of {surrogate!r}"):
        for outcome in conformance(server, token_from(context, token, token_file), surrogate):
            outcomes.append(outcome)
            if not as_json and (outcome.failure or not quiet):
                typer.echo(visible(f"✗ {outcome.name}: {outcome.failure}") if outcome.failure else f"✓ {outcome.name}")
    failed = [outcome for outcome in outcomes if outcome.failure]
    result = {"passed": len(outcomes) - len(failed), "failed": {o.name: o.failure for o in failed}}
    give(result, lambda: f"{result['passed']} of {len(outcomes)} checks passed", as_json=as_json, quiet=quiet)
    if failed:
        raise typer.Exit(1)
