"""``surrogym report``: one page about a surrogate."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from surrogym_client.cli.groups import Output, Service, add
from surrogym_client.cli.options import Surrogate, connect


def register(app: typer.Typer) -> None:
    """Add the command."""
    add(app, "report", command)


def command(
    context: typer.Context,
    surrogate: Surrogate,
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write.")] = Path("report.html"),
    *,
    service: Service,
    output: Output,
) -> None:
    """Write one HTML page that needs nothing else. It has fidelity against samples, where they fell, maps of
    uncertainty, occupancy and index, the ledger, structure and hyperparameters, and every model.

    Example: surrogym report pendulum --out report.html
    """
    from surrogym_shared.terminal import on_interrupt, progress

    token = service.token_for(context)
    stays = "interrupted; nothing was written, and the same command begins anew"
    with (
        on_interrupt(lambda: stays),
        progress("report", quiet=output.quiet) as update,
        connect(service.server, token) as api,
    ):
        update(0.0, f"reading {surrogate}")
        view, models, samples = api.surrogate(surrogate), api.models(surrogate), list(api.samples(surrogate))
        from surrogym_client.errors import NotInstalled
        from surrogym_client.report.maps import cuts

        without = ""
        try:
            shown = cuts(view, partial(api.query_uncertainty, surrogate))
        except NotInstalled as error:  # the page says all that was stored
            shown, without = [], f", without maps: {error}"
        update(0.3, "drawing")
        from surrogym_client.report.page import page

        text = page(view, models, samples, f"{api.url}, surrogym {api.health().version}", shown)
        size = out.write_text(text, encoding="utf-8")
        update(1.0, "done")
    words = f"{size} bytes written to {out}{without}"
    output.give({"file": str(out), "bytes": size}, lambda: words)
