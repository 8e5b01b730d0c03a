"""``surrogym import``: a surrogate from its file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from surrogym_client.cli.options import AsJson, Quiet, Server, Token, TokenFile, connect, token_from


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("import")(command)


def command(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help="What surrogym export wrote with the ending .surrogate.")],
    name: Annotated[str | None, typer.Option(help="Name of the surrogate. [default: as in the file]")] = None,
    server: Server = None,
    token: Token = None,
    token_file: TokenFile = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Make a surrogate of a file. It serves the same model at once, judged by the same tolerances, its design paused.

    Its real samples are stored as manual ones. surrogym change NAME --resume lets the design go on, with its initial
    queries first.

    Example: surrogym import pendulum.surrogate --name pendulum-2
    """
    from surrogym_client.surrogates.transfer import import_surrogate
    from surrogym_shared.surrogate_file import SurrogateFile
    from surrogym_shared.terminal import give, on_interrupt, progress

    token = token_from(context, token, token_file)
    stays = "interrupted; nothing stays of it at the server, and the same command begins anew"
    with (
        on_interrupt(lambda: stays),
        progress("import", quiet=quiet) as update,
        connect(server, token) as api,
    ):
        update(0.0, f"reading {file}")
        read = SurrogateFile.load(file)
        view = import_surrogate(api, read, name, lambda share: update(share, f"{len(read.samples)} real samples"))
    words = (
        f"{view.name}: {view.environment or 'own environment'}, model {view.model_version} and {view.samples} real "
        f"samples{_origin(read.ledger)}, design paused; next: surrogym train {view.name}"
    )
    give(view.model_dump(mode="json"), lambda: words, as_json=as_json, quiet=quiet)


def _origin(ledger: dict[str, int]) -> str:
    """What the real steps were where the file comes from."""
    steps = ", ".join(f"{count} {purpose}" for purpose, count in ledger.items() if count)
    return f" (there {steps})" if steps else ""
