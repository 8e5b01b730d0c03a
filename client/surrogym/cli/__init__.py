"""The ``surrogym`` command. Each file of ``commands`` is one command. The other files here hold what the commands
use.

Other packages add commands through an entry point. The help lists commands in groups, and options for experts in a
section of their own. An error names the replacement of a command or an option that was removed.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from surrogym.cli.errors import notes_of, sentence
from surrogym.cli.groups import add
from surrogym_shared.removed import remark
from surrogym_shared.terminal import say

GROUPS: Mapping[str, tuple[str, ...]] = {
    "Start": ("demo", "serve", "doctor"),
    "Loop": ("describe", "register", "sample", "prior", "train", "audit", "evaluate", "status"),
    "After": (
        *("report", "policies", "policy", "improve", "change", "export", "import", "export-policy", "deploy", "delete"),
    ),
    "Operate": ("watch", "renew", "work", "jobs", "conformance"),
}
REST = "More"  # heading, in the help, over the commands that belong to no group, such as those of other packages
ADVANCED: Mapping[str, frozenset[str]] = {  # for each command, the options for experts, which its help lists last
    "deploy": frozenset({"--algorithm", "--trust-policy", "--spec", "--episodes"}),
    "evaluate": frozenset(
        {"--wide", "--start-scale", "--perturb", "--explore", "--parallel", "--algorithm", "--where", "--learn"}
        | {"--learn-all", "--compare", "--reference", "--video"}
    ),
    "register": frozenset({"--preset", "--acquisition", "--initial", "--target", "--bins"}),
    "sample": frozenset(
        {"--worker", "--once", "--time-limit", "--most-snapshots", "--most-bytes", "--on-ray", "--ray-address"}
        | {"--ray-resources", "--runtime-env"}
    ),
    "serve": frozenset({"--engine", "--ray-address", "--ray-hosts", "--ready-file", "--exit-with-parent"}),
    "train": frozenset(
        {"--variant", "--particles", "--spread", "--process-noise", "--start-box"}
        | {"--start-visited", "--horizon", "--penalty", "--trust", "--num-envs", "--audit-steps"}
        | {"--tensorboard"}
    ),
}


class Command(TyperCommand):
    """One command of ``surrogym``. Its help lists the options for experts last, under "Advanced"."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the sections of arguments, options and advanced options to the help of a command."""
        sections: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": [], "Advanced": []}
        advanced = ADVANCED.get(self.name or "", frozenset())
        for parameter in self.get_params(ctx):
            if (record := parameter.get_help_record(ctx)) is None:
                continue
            argument, expert = parameter.param_type_name == "argument", advanced.intersection(parameter.opts)
            sections["Arguments" if argument else "Advanced" if expert else "Options"].append(record)
        _write(formatter, sections)


class Commands(TyperGroup):
    """Group of all commands of ``surrogym``. The error about a command or an option that was removed names its
    replacement."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a section for each group of commands to the help of ``surrogym``."""
        known = {name: command for name in self.list_commands(ctx) if (command := self.get_command(ctx, name))}
        shown = {name: command for name, command in known.items() if not command.hidden}
        grouped = {name for names in GROUPS.values() for name in names}
        groups = {**GROUPS, REST: tuple(name for name in shown if name not in grouped)}
        width = max(map(len, shown), default=0)
        limit = formatter.width - 6 - width
        sections = {
            heading: [(name.ljust(width), shown[name].get_short_help_str(limit)) for name in names if name in shown]
            for heading, names in groups.items()
        }
        _write(formatter, sections)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command that the arguments begin with. The error about a removed one names its replacement."""
        if (said := remark("command", args[0])) and self.get_command(ctx, args[0]) is None:
            ctx.fail(f"No such command: {args[0]}{said}")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Run the command, and add the replacement of a removed option to the error about it."""
        try:
            return super().invoke(ctx)
        except Exception as error:
            # only NoSuchOption, a class that typer hides, has this attribute
            option = getattr(error, "option_name", None)
            if option is not None and (said := remark(f"option of {ctx.invoked_subcommand}", option)):
                error.message += said  # type: ignore[attr-defined]
                error.possibilities = None  # type: ignore[attr-defined]
            raise


def _write(formatter: Any, sections: Mapping[str, list[tuple[str, str]]]) -> None:
    for heading, rows in sections.items():
        if rows:
            with formatter.section(heading):
                formatter.write_dl(rows)


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
    "renew",
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
    _open_closed_streams()
    try:
        built()(args=None if arguments is None else list(arguments), prog_name=name)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except Exception as error:
        message = sentence(error)
        if message is None:
            raise
        say(f"error: {'; '.join([message, *notes_of(error)])}")
        sys.exit(1)


def _open_closed_streams() -> None:
    """Open the null device in place of each standard stream that was closed before this process started (``>&-``),
    because Python has None there."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115, it stays open until the process ends


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
