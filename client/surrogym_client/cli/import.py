"""``surrogym import``: a surrogate from its file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from surrogym_client.cli.groups import Output, Service, add
from surrogym_client.cli.options import connect


def register(app: typer.Typer) -> None:
    """Add the command."""
    add(app, "import", command)


def command(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help="What surrogym export wrote with the ending .surrogate.")],
    name: Annotated[str | None, typer.Option(help="Name of the surrogate. [default: as in the file]")] = None,
    *,
    service: Service,
    output: Output,
) -> None:
    """Make a surrogate of a file. It serves the same model at once, judged by the same tolerances, its design paused.

    Its real samples are stored as manual ones. surrogym change NAME --resume lets the design go on, with its initial
    queries first.

    Example: surrogym import pendulum.surrogate --name pendulum-2
    """
    from surrogym_client.surrogates.transfer import import_surrogate
    from surrogym_shared.surrogate_file import SurrogateFile
    from surrogym_shared.terminal import on_interrupt, progress

    token = service.token_for(context)
    stays = "interrupted; nothing stays of it at the server, and the same command begins anew"
    with (
        on_interrupt(lambda: stays),
        progress("import", quiet=output.quiet) as update,
        connect(service.server, token) as api,
    ):
        update(0.0, f"reading {file}")
        read = SurrogateFile.load(file)
        view = import_surrogate(api, read, name, lambda share: update(share, f"{len(read.samples)} real samples"))
    words = (
        f"{view.name}: {view.environment or 'own environment'}, model {view.model_version} and {view.samples} real "
        f"samples{_origin(read.ledger)}, design paused; next: surrogym train {view.name}"
    )
    output.give(view.model_dump(mode="json"), lambda: words)


def _origin(ledger: dict[str, int]) -> str:
    """What the real steps were where the file comes from."""
    steps = ", ".join(f"{count} {purpose}" for purpose, count in ledger.items() if count)
    return f" (there {steps})" if steps else ""
