"""``surrogym serve``: run the server."""

from __future__ import annotations

import os
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer

from surrogym_server.errors import InvalidInput, SurrogymError
from surrogym_shared.terminal import give, progress

WORKERS_VARIABLE = "WEB_CONCURRENCY"


def register(app: typer.Typer) -> None:
    """Add ``serve`` to an app of commands."""
    app.command()(serve)


def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on. [default: 127.0.0.1]")] = None,
    port: Annotated[int | None, typer.Option(help="Port; 0 takes any free one. [default: 8000]")] = None,
    database: Annotated[
        str | None, typer.Option(help="SQLite file, or a SQLAlchemy URL. [default: surrogym.db]")
    ] = None,
    synchronous: Annotated[
        str | None, typer.Option(help="Of a SQLite file: full waits for the disk, normal not always. [default: full]")
    ] = None,
    token_file: Annotated[
        Path | None, typer.Option(help="File with one token a line: an admin token, or role:token.")
    ] = None,
    insecure: Annotated[
        bool | None, typer.Option("--insecure", help="Allow another address than loopback without a token.")
    ] = None,
    public_url: Annotated[
        str | None, typer.Option(help="Address that browsers know the server by, where a proxy stands before it.")
    ] = None,
    tls_certificate: Annotated[Path | None, typer.Option(help="PEM file; the server then speaks HTTPS alone.")] = None,
    tls_key: Annotated[Path | None, typer.Option(help="PEM file with the certificate's private key.")] = None,
    device: Annotated[
        str | None, typer.Option(help="What steps sessions: cpu, or cuda where torch has it. [default: cpu]")
    ] = None,
    threads: Annotated[int | None, typer.Option(help="Threads of one torch operation. [default: 1]")] = None,
    session_idle_seconds: Annotated[
        float | None, typer.Option(help="Idle time after which a session expires. [default: 3600]")
    ] = None,
    log_level: Annotated[
        str | None, typer.Option(help="critical, error, warning, info or debug. [default: info]")
    ] = None,
    log_format: Annotated[str | None, typer.Option(help="text, or json: one object a line. [default: text]")] = None,
    ready_file: Annotated[
        Path | None, typer.Option(help="File to write the URL to, once the server accepts requests.")
    ] = None,
    exit_with_parent: Annotated[
        bool, typer.Option("--exit-with-parent", help="End when the process that started this one ends.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print address and version as JSON, once the server accepts requests.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No remarks; the log is what --log-level says.")] = False,
) -> None:
    """Run the server until Ctrl-C.

    SIGTERM and the end of its terminal (SIGHUP, unless ignored as under nohup) end it as cleanly: sessions are saved.

    Most options can also be given as environment variables, such as SURROGYM_PORT; a token as SURROGYM_TOKEN.

    Example: surrogym serve --port 8000 --database surrogym.db
    """
    from surrogym_server.settings import read_settings

    try:
        _refuse_workers()
        settings = read_settings(
            os.environ,
            host=host,
            port=port,
            database=database,
            synchronous=synchronous,
            token_file=token_file,
            insecure=insecure,
            public_url=public_url,
            tls_certificate=tls_certificate,
            tls_key=tls_key,
            device=device,
            threads=threads,
            session_idle_seconds=session_idle_seconds,
            log_level=log_level,
            log_format=log_format,
        )
        with progress("serve", quiet=quiet or not sys.stderr.isatty()) as update:
            update(None, "importing torch")
            from surrogym_server.cli import runner  # neither --help nor a refusal should wait for it

        def tell(url: str) -> None:
            about = {"url": url, "version": version("surrogym")}
            give(about, lambda: f"Surrogym listens on {url}", as_json=as_json, quiet=quiet)
            sys.stdout.flush()

        runner.run(settings, ready_file, exit_with_parent, tell)
    except SurrogymError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(1) from None


def _refuse_workers() -> None:
    workers = os.environ.get(WORKERS_VARIABLE, "1")
    if workers != "1":
        raise InvalidInput(
            f"expected one worker process, got {WORKERS_VARIABLE}={workers}: sessions live in one process"
        )
