"""``surrogym conformance``: check that a server follows the protocol."""

from __future__ import annotations

from typing import Annotated

import typer

from surrogym_client.cli.groups import Output, Service, add


def register(app: typer.Typer) -> None:
    """Add ``surrogym conformance`` to the app."""
    add(app, "conformance", command)


def command(
    context: typer.Context,
    surrogate: Annotated[
        str,
        typer.Option("--surrogate", help="Name for a temporary surrogate, not yet in use. It is deleted at the end."),
    ] = "conformance",
    *,
    service: Service,
    output: Output,
) -> None:
    """Check that a server follows the protocol.

    Each check prints one line. The exit status is 1 if a check fails. With --quiet, only failed checks are shown.

    Example: surrogym conformance --server http://127.0.0.1:8000
    """
    from surrogym_client.diagnosis.conformance import conformance
    from surrogym_shared.terminal import on_interrupt, visible

    outcomes = []
    with on_interrupt(lambda: f"interrupted; {surrogate!r} was deleted"):
        for outcome in conformance(service.server, service.token_for(context), surrogate):
            outcomes.append(outcome)
            if not output.as_json and (outcome.failure or not output.quiet):
                typer.echo(visible(f"✗ {outcome.name}: {outcome.failure}") if outcome.failure else f"✓ {outcome.name}")
    failed = [outcome for outcome in outcomes if outcome.failure]
    result = {"passed": len(outcomes) - len(failed), "failed": {o.name: o.failure for o in failed}}
    output.give(result, lambda: f"{result['passed']} of {len(outcomes)} checks passed")
    if failed:
        raise typer.Exit(1)
