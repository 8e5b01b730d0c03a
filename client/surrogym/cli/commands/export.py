"""``surrogym export``: write a surrogate, its samples, its model or its specification to a file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surrogym.cli.errors import CommandError
from surrogym.cli.groups import Output, Service
from surrogym.cli.options import Surrogate, connect, first_model, working

if TYPE_CHECKING:
    from surrogym_client.transport.api import Api

OF_A_MODEL = (".surrogate", ".safetensors")  # endings of files that hold a model


def command(
    context: typer.Context,
    surrogate: Surrogate,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="File to write. Its ending chooses the content: .surrogate, .csv, .npz, .safetensors or .json.",
        ),
    ],
    *,
    service: Service,
    output: Output,
) -> None:
    """Write a surrogate, or a part of it, to a file.

    The file's ending chooses the content: the whole surrogate for surrogym import (.surrogate), every real sample (.csv
    or .npz), the latest model (.safetensors), or the specification (.json).

    Example: surrogym export pendulum --out pendulum.surrogate

    Example: surrogym export pendulum --out samples.csv
    """
    token = service.token_for(context)
    stays = "interrupted; nothing was written; the same command starts from the beginning"
    if out.suffix.lower() in OF_A_MODEL:
        with connect(service.server, token) as api:
            first_model(api, surrogate, quiet=output.quiet)
    with working("export", stays, quiet=output.quiet) as update, connect(service.server, token) as api:
        update(0.0, f"reading {surrogate}")
        content = _content(api, surrogate, out)
        out.write_bytes(content)
        update(1.0, "done")
    words = f"{len(content)} bytes written to {out}"
    output.give({"file": str(out), "bytes": len(content)}, lambda: words)


def _content(api: Api, surrogate: str, out: Path) -> bytes:
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
