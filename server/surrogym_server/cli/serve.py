"""``surrogym serve``: run the server."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer

from surrogym_server.errors import InvalidInput, SurrogymError
from surrogym_shared.terminal import give, progress

WORKERS_VARIABLE = "WEB_CONCURRENCY"
# Options of the command that are not in ``Settings``.
OF_THE_COMMAND = ("ready_file", "exit_with_parent", "as_json", "quiet")

Host = Annotated[str | None, typer.Option(help="Address to listen on. [default: 127.0.0.1]")]
Port = Annotated[int | None, typer.Option(help="Port to listen on; 0 takes any free one. [default: 8000]")]
Database = Annotated[
    str | None, typer.Option(help="Database: a SQLite file or a SQLAlchemy URL. [default: surrogym.db]")
]
TokenFile = Annotated[
    Path | None, typer.Option(help="File with one token per line: role:token, or an admin's token alone.")
]
Insecure = Annotated[
    bool | None,
    typer.Option("--insecure", help="Allow to listen without a token on addresses that other machines can reach."),
]
PublicUrl = Annotated[str | None, typer.Option(help="URL of the server as browsers see it, if it is behind a proxy.")]
TlsCertificate = Annotated[
    Path | None, typer.Option(help="PEM file with the certificate. The server then accepts HTTPS only.")
]
TlsKey = Annotated[Path | None, typer.Option(help="PEM file with the certificate's private key.")]
Device = Annotated[
    str | None,
    typer.Option(help="Device that computes the steps of sessions: cpu, or cuda if torch supports it. [default: cpu]"),
]
Threads = Annotated[
    int | None,
    typer.Option(
        help="Number of threads of one torch operation, and of a compiled step of a large model. [default: 1]"
    ),
]
SessionIdleSeconds = Annotated[
    float | None, typer.Option(help="Seconds without a request after which a session expires. [default: 3600]")
]
FitSeconds = Annotated[
    float | None, typer.Option(help="Seconds after which a fit is stopped and counts as failed. [default: 3600]")
]
Engine = Annotated[
    str | None,
    typer.Option(help="Where sessions run: local for this process, or ray for a Ray cluster. [default: local]"),
]
RayAddress = Annotated[
    str | None,
    typer.Option(help="Address of the Ray cluster; auto finds the one that this machine belongs to. [default: auto]"),
]
RayHosts = Annotated[
    int | None,
    typer.Option(help="Number of processes in the cluster that hold sessions, each with one CPU. [default: 2]"),
]
FitWorkers = Annotated[
    int | None,
    typer.Option(help="Number of surrogates that are fitted at the same time, each in a process. [default: 1]"),
]
LogLevel = Annotated[
    str | None, typer.Option(help="Lowest level to log: critical, error, warning, info or debug. [default: info]")
]
LogFormat = Annotated[
    str | None, typer.Option(help="Format of the log: text, or json with one object per line. [default: text]")
]
ReadyFile = Annotated[Path | None, typer.Option(help="File to write the URL to, once the server accepts requests.")]
ExitWithParent = Annotated[
    bool, typer.Option("--exit-with-parent", help="Stop when the process that started the server ends.")
]
AsJson = Annotated[
    bool, typer.Option("--json", help="Print URL and version as JSON, once the server accepts requests.")
]
Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="Don't print the address or progress. The log still follows --log-level.")
]


def register(app: typer.Typer) -> None:
    """Add the command ``serve`` to a typer app."""
    app.command()(serve)


def serve(
    context: typer.Context,
    host: Host = None,
    port: Port = None,
    database: Database = None,
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

    SIGTERM stops the server as well, and so does closing its terminal (SIGHUP), unless it runs under nohup. Each of
    them saves the sessions.

    Most options can also be set by environment variables, such as SURROGYM_PORT. SURROGYM_TOKEN sets the token.

    Example: surrogym serve --port 8000 --database surrogym.db
    """
    gc.disable()  # collecting garbage among imported modules takes an eighth of the start-up time
    try:
        from surrogym_server.settings import read_settings

        _refuse_workers()
        given = {name: value for name, value in context.params.items() if name not in OF_THE_COMMAND}
        settings = read_settings(os.environ, **given)
        if settings.engine != "ray":
            _refuse_options_of_ray(given)
        with progress("serve", quiet=quiet or not sys.stderr.isatty()) as update:
            update(None, "importing torch")
            from surrogym_server.cli import runner  # imported here, so that --help and refusals need not wait for torch

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


def _refuse_options_of_ray(given: Mapping[str, Any]) -> None:
    """Raise ``InvalidInput`` if an option for Ray is given, because another engine is chosen. Environment variables for
    Ray are not checked."""
    for name in ("ray_address", "ray_hosts"):
        if given[name] is not None:
            raise InvalidInput(
                f"--{name.replace('_', '-')}: expected --engine ray with it, got the engine local: add --engine ray "
                "or omit this option"
            )


def _refuse_workers() -> None:
    workers = os.environ.get(WORKERS_VARIABLE, "1")
    if workers != "1":
        raise InvalidInput(
            f"expected one server process, got {WORKERS_VARIABLE}={workers}: unset this variable, because sessions "
            "live in one process"
        )
