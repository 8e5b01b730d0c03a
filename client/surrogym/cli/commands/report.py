"""``surrogym report``: write one page about a surrogate and its policy."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from surrogym.cli.groups import Output, Service
from surrogym.cli.options import Surrogate, working


def command(
    context: typer.Context,
    surrogate: Surrogate,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="File to write: .html, or .pdf, which needs Chromium.")
    ] = Path("report.html"),
    policy: Annotated[
        str | None,
        typer.Option(help="Version or alias of the policy. [default: the one in production, or else the newest]"),
    ] = None,
    controller: Annotated[
        Path | None,
        typer.Option(help="Folder of the policy's controller, with what surrogym deploy --check found."),
    ] = None,
    *,
    service: Service,
    output: Output,
) -> None:
    """Write a report about a surrogate and its policy.

    The report is one HTML file that needs no other file. Its first part is for decisions: cost, real return with and
    without the policy, intervals, the prediction, what was not tested, and next steps. Its second part is for
    engineers: fidelity, samples, maps, counts of real steps, structure and hyperparameters, and every model.

    Example: surrogym report pendulum --out report.html
    """
    stays = "interrupted; nothing was written; the same command starts from the beginning"
    with working("report", stays, quiet=output.quiet) as update, service.connect(context) as api:
        update(0.0, f"reading {surrogate}")
        from surrogym_trainer.report.known import collect, cuts_of

        known = collect(api, surrogate, policy, controller)
        # maps of the model's uncertainty; if they can't be computed, an empty list, and the reason in ``lacking``
        shown, lacking = cuts_of(api, known)
        update(0.3, "drawing")
        from surrogym_trainer.report.page import page, write

        size = write(out, page(known, shown))
        update(1.0, "done")
    about = "no policy yet" if known.policy is None else f"{surrogate}@{known.policy.version}"
    words = f"{size} bytes written to {out}, about {about}{f', without maps: {lacking}' if lacking else ''}"
    version = None if known.policy is None else known.policy.version
    output.give({"file": str(out), "bytes": size, "version": version}, lambda: words)
