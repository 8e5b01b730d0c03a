"""``surrogym export``: a whole surrogate, its real samples, its latest model or its specification as a file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surrogym_client.cli.options import AsJson, Quiet, Server, Surrogate, Token, TokenFile, connect, token_from

if TYPE_CHECKING:
    from surrogym_client.transport.api import Api


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("export")(command)


def command(
    context: typer.Context,
    surrogate: Surrogate,
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help="File to write; its ending says what: .surrogate, .csv, .npz, .safetensors, .json."
        ),
    ],
    server: Server = None,
    token: Token = None,
    token_file: TokenFile = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write a whole surrogate into one file (.surrogate). It is what surrogym import takes. Other endings write
    a part alone: every real sample (.csv, .npz), the latest model (.safetensors), the specification (.json).

    Example: surrogym export pendulum --out pendulum.surrogate

    Example: surrogym export pendulum --out samples.csv
    """
    from surrogym_shared.terminal import give, on_interrupt, progress

    token = token_from(context, token, token_file)
    stays = "interrupted; nothing was written, and the same command begins anew"
    with (
        on_interrupt(lambda: stays),
        progress("export", quiet=quiet) as update,
        connect(server, token) as api,
    ):
        update(0.0, f"reading {surrogate}")
        content = _content(api, surrogate, out)
        out.write_bytes(content)
        update(1.0, "done")
    words = f"{len(content)} bytes written to {out}"
    give({"file": str(out), "bytes": len(content)}, lambda: words, as_json=as_json, quiet=quiet)


def _content(api: Api, surrogate: str, out: Path) -> bytes:
    from surrogym_client.cli.errors import CommandError

    match out.suffix.lower():
        case ".surrogate":
            from surrogym_client.surrogates.transfer import export_surrogate

            return export_surrogate(api, surrogate).to_bytes()
        case ".csv":
            return api.export_samples(surrogate, "csv")
        case ".npz":
            return api.export_samples(surrogate, "npz")
        case ".json":
            return api.surrogate(surrogate).spec.model_dump_json(indent=2).encode()
        case ".safetensors":
            return api.export_model(surrogate, api.model(surrogate).version)
        case other:
            raise CommandError(
                f"expected a file ending in .surrogate, .csv, .npz, .safetensors or .json, got {other or 'no ending'!r}"
            )
