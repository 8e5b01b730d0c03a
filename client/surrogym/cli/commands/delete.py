"""``surrogym delete``: remove a surrogate with all its samples."""

from __future__ import annotations

from typing import Annotated

import typer

from surrogym.cli.groups import Output, Service
from surrogym.cli.options import Surrogate


def command(
    context: typer.Context,
    surrogate: Surrogate,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Delete without a confirmation.")] = False,
    *,
    service: Service,
    output: Output,
) -> None:
    """Delete a surrogate with its samples, models and sessions.

    Its policies are deleted too. This can't be undone.

    Example: surrogym delete pendulum --yes
    """

    with service.connect(context) as api:
        view = api.surrogate(surrogate)
        if not yes:
            typer.confirm(f"Delete {surrogate!r} with its {view.samples} real samples?", abort=True, err=True)
        api.delete_surrogate(surrogate)
    output.give({"deleted": surrogate}, lambda: f"{surrogate} deleted")
