"""``surrogym report``: one page about a surrogate and its policy."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from surrogym_client.cli.groups import Output, Service, add
from surrogym_client.cli.options import Surrogate


def register(app: typer.Typer) -> None:
    """Add the command."""
    add(app, "report", command)


def command(
    context: typer.Context,
    surrogate: Surrogate,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="File to write: .html, or .pdf, which needs Chromium.")
    ] = Path("report.html"),
    policy: Annotated[
        str | None,
        typer.Option(help="Version or alias of the policy. [default: the one in production, otherwise the newest]"),
    ] = None,
    *,
    service: Service,
    output: Output,
) -> None:
    """Write one HTML page that needs nothing else.

    First for whoever decides: what it cost, what the policy gives in reality with intervals, with and without it,
    whether that was predicted, what was not tested, what to do next. Then for whoever works: fidelity, samples, maps,
    the ledger, structure and hyperparameters, and every model.

    Example: surrogym report pendulum --out report.html
    """
    from surrogym_shared.terminal import on_interrupt, progress

    stays = "interrupted; nothing was written, and the same command begins anew"
    with (
        on_interrupt(lambda: stays),
        progress("report", quiet=output.quiet) as update,
        service.connect(context) as api,
    ):
        update(0.0, f"reading {surrogate}")
        from surrogym_client.report.known import collect, cuts_of

        known = collect(api, surrogate, policy)
        shown, lacking = cuts_of(api, known)  # without maps, the page says all that was stored
        update(0.3, "drawing")
        from surrogym_client.report.files import write
        from surrogym_client.report.page import page

        size = write(out, page(known, shown))
        update(1.0, "done")
    about = "no policy yet" if known.policy is None else f"{surrogate}@{known.policy.version}"
    words = f"{size} bytes written to {out}, about {about}{f', without maps: {lacking}' if lacking else ''}"
    version = None if known.policy is None else known.policy.version
    output.give({"file": str(out), "bytes": size, "version": version}, lambda: words)
