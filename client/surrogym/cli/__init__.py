"""The ``surrogym`` command. Each file of ``commands`` is one command. The other files here hold what the commands use.

Other packages add commands through an entry point.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.metadata import entry_points

import typer

from surrogym.cli.errors import sentence
from surrogym.cli.groups import add
from surrogym.cli.help import Command, Commands
from surrogym_shared.terminal import say

COMMANDS = (
    "describe",
    "register",
    "sample",
    "train",
    "work",
    "jobs",
    "audit",
    "evaluate",
    "watch",
    "policies",
    "policy",
    "status",
    "report",
    "improve",
    "prior",
    "change",
    "export",
    "import",
    "export-policy",
    "deploy",
    "delete",
    "doctor",
    "conformance",
    "demo",
)
ENTRY_POINTS = "surrogym.commands"
INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit.

    The exit status is 0 for success, 1 for failure, 2 for wrong usage, and 130 after Ctrl-C.
    """
    run(build, "surrogym", arguments)


def run(built: Callable[[], typer.Typer], name: str, arguments: Sequence[str] | None = None) -> None:
    """Build a command-line app, run one of its commands, and exit.

    The exit status is 0 for success, 1 for failure, 2 for wrong usage, and 130 after Ctrl-C.

    Args:
        built: builds the app.
        name: name of the program in messages.
        arguments: arguments of the program; None takes those of this process.
    """
    try:
        built()(args=None if arguments is None else list(arguments), prog_name=name)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except Exception as error:
        message = sentence(error)
        if message is None:
            raise
        say(f"error: {message}")
        sys.exit(1)


def build() -> typer.Typer:
    """Build the app with all commands: those of this package, and those of other packages by entry points."""
    app = typer.Typer(
        name="surrogym",
        cls=Commands,
        help="Learn a virtual environment from a handful of real steps, serve it, and train on it.",
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    app.callback()(_version)
    for name in COMMANDS:
        module = import_module(f"{__name__}.commands.{name.replace('-', '_')}")
        if hasattr(module, "group"):
            app.add_typer(module.group(), name=name)
        else:
            add(app, name, module.command)
    for entry in entry_points(group=ENTRY_POINTS):
        entry.load()(app)
    for info in app.registered_commands:
        info.cls = Command
    return app


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"surrogym {version('surrogym')}")
        raise typer.Exit


def _version(
    version: bool = typer.Option(
        False, "--version", is_eager=True, callback=_show_version, help="Print the version and exit."
    ),
) -> None:
    """Learn a virtual environment from a handful of real steps, serve it, and train on it."""
    del version  # the callback of the option has printed the version
