"""Entry point of ``python -m surrogym_server serve``, which runs a server without the client's commands."""

from __future__ import annotations

import typer

from surrogym_server.cli import serve


def main() -> None:
    """Run the command line of the server."""
    app = typer.Typer(name="surrogym-server", no_args_is_help=True, add_completion=False)
    app.callback()(_keep_names)
    serve.register(app)
    app()


def _keep_names() -> None:
    """Run the Surrogym server."""


if __name__ == "__main__":
    main()
