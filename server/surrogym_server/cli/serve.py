"""``surrogym serve``: run the server."""

from __future__ import annotations

import gc
import os
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer

from surrogym_server.errors import InvalidInput, SurrogymError
from surrogym_shared.terminal import give, progress

WORKERS_VARIABLE = "WEB_CONCURRENCY"
OF_THE_COMMAND = ("ready_file", "exit_with_parent", "as_json", "quiet")  # its other options are settings

Host = Annotated[str | None, typer.Option(help="Address to listen on. [default: 127.0.0.1]")]
Port = Annotated[int | None, typer.Option(help="Port; 0 takes any free one. [default: 8000]")]
Database = Annotated[str | None, typer.Option(help="SQLite file, or a SQLAlchemy URL. [default: surrogym.db]")]
Synchronous = Annotated[
    str | None, typer.Option(help="Of a SQLite file: full waits for the disk, normal not always. [default: full]")
]
TokenFile = Annotated[Path | None, typer.Option(help="File with one token a line: an admin token, or role:token.")]
Insecure = Annotated[
    bool | None, typer.Option("--insecure", help="Allow another address than loopback without a token.")
]
PublicUrl = Annotated[
    str | None, typer.Option(help="Address that browsers know the server by, where a proxy stands before it.")
]
TlsCertificate = Annotated[Path | None, typer.Option(help="PEM file; the server then speaks HTTPS alone.")]
TlsKey = Annotated[Path | None, typer.Option(help="PEM file with the certificate's private key.")]
Device = Annotated[
    str | None, typer.Option(help="What steps sessions: cpu, or cuda where torch has it. [default: cpu]")
]
Threads = Annotated[int | None, typer.Option(help="Threads of one torch operation. [default: 1]")]
SessionIdleSeconds = Annotated[
    float | None, typer.Option(help="Idle time after which a session expires. [default: 3600]")
]
FitSeconds = Annotated[
    float | None, typer.Option(help="Time after which a fit is ended, and has failed. [default: 3600]")
]
Engine = Annotated[
    str | None, typer.Option(help="Where sessions are: local, in this process, or ray, in a cluster. [default: local]")
]
RayAddress = Annotated[
    str | None, typer.Option(help="Ray cluster; auto finds the one that this machine belongs to. [default: auto]")
]
RayHosts = Annotated[
    int | None, typer.Option(help="Processes of the cluster that hold sessions, each with a CPU. [default: 2]")
]
FitWorkers = Annotated[
    int | None, typer.Option(help="Fits of different surrogates at once, each in a process. [default: 1]")
]
LogLevel = Annotated[str | None, typer.Option(help="critical, error, warning, info or debug. [default: info]")]
LogFormat = Annotated[str | None, typer.Option(help="text, or json: one object a line. [default: text]")]
ReadyFile = Annotated[Path | None, typer.Option(help="File to write the URL to, once the server accepts requests.")]
ExitWithParent = Annotated[
    bool, typer.Option("--exit-with-parent", help="End when the process that started this one ends.")
]
AsJson = Annotated[
    bool, typer.Option("--json", help="Print address and version as JSON, once the server accepts requests.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No remarks; the log is what --log-level says.")]


def register(app: typer.Typer) -> None:
    """Add ``serve`` to an app of commands."""
    app.command()(serve)


def serve(
    context: typer.Context,
    host: Host = None,
    port: Port = None,
    database: Database = None,
    synchronous: Synchronous = None,
    token_file: TokenFile = None,
    insecure: Insecure = None,
    public_url: PublicUrl = None,
    tls_certificate: TlsCertificate = None,
    tls_key: TlsKey = None,
    device: Device = None,
    threads: Threads = None,
    session_idle_seconds: SessionIdleSeconds = None,
    fit_seconds: FitSeconds = None,
    fit_workers: FitWorkers = None,
    engine: Engine = None,
    ray_address: RayAddress = None,
    ray_hosts: RayHosts = None,
    log_level: LogLevel = None,
    log_format: LogFormat = None,
    ready_file: ReadyFile = None,
    exit_with_parent: ExitWithParent = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Run the server until Ctrl-C.

    SIGTERM and the end of its terminal (SIGHUP, unless ignored as under nohup) end it as cleanly: sessions are saved.

    Most options can also be given as environment variables, such as SURROGYM_PORT; a token as SURROGYM_TOKEN.

    Example: surrogym serve --port 8000 --database surrogym.db
    """
    gc.disable()  # what is imported stays: to look for garbage in it takes an eighth of the start
    try:
        from surrogym_server.settings import read_settings

        _refuse_workers()
        given = {name: value for name, value in context.params.items() if name not in OF_THE_COMMAND}
        settings = read_settings(os.environ, **given)
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
    finally:
        gc.enable()


def _refuse_workers() -> None:
    workers = os.environ.get(WORKERS_VARIABLE, "1")
    if workers != "1":
        raise InvalidInput(
            f"expected one worker process, got {WORKERS_VARIABLE}={workers}: sessions live in one process"
        )
