"""``surrogym export``: the real samples as a file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from surrogym_client.cli.options import AsJson, Quiet, Server, Token, connect


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("export")(command)


def command(
    surrogate: Annotated[str, typer.Argument(help="Name of the surrogate.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write; .csv or .npz says the format.")],
    server: Server = None,
    token: Token = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write every real sample of a surrogate to a file.

    Example: surrogym export pendulum --out samples.csv
    """
    from surrogym_client.cli.output import give

    file_format = _format(out)
    with connect(server, token) as api:
        content = api.export_samples(surrogate, file_format)
    out.write_bytes(content)
    words = f"{len(content)} bytes written to {out}"
    give({"file": str(out), "bytes": len(content)}, lambda: words, as_json=as_json, quiet=quiet)


def _format(out: Path) -> Literal["csv", "npz"]:
    from surrogym_client.cli.errors import CommandError

    match out.suffix.lower():
        case ".csv":
            return "csv"
        case ".npz":
            return "npz"
        case other:
            raise CommandError(f"expected a file ending in .csv or .npz, got {other or 'no ending'!r}")
