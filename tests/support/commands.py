"""The ``surrogym`` command as a parser: whether a line that a person would type means anything."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import typer

from surrogym.cli import build


@cache
def command_line(build: Callable[[], typer.Typer] = build) -> Any:
    """The parser of ``surrogym``, or of another program."""
    return typer.main.get_command(build())


def options(*names: str) -> set[str]:
    """All spellings of a command's options, without a name those of the program; ``options("policy", "show")`` for
    one within a group.

    Raises:
        KeyError: no such command.
    """
    command = command_line()
    for name in names:
        command = command.commands[name]
    spellings = {spelling for parameter in command.params for spelling in (*parameter.opts, *parameter.secondary_opts)}
    return spellings | {"--help"}


def parse(arguments: list[str], build: Callable[[], typer.Typer] = build) -> dict[str, Any]:
    """The values that ``surrogym ARGUMENTS`` gives its command, or another program its own, which is not run.

    Raises:
        KeyError: no such command.
        Exception: the usage error that a person would see.
    """
    command, name, rest = command_line(build), "surrogym", arguments
    while hasattr(command, "commands"):
        name, *rest = rest
        if name not in command.commands and (default := getattr(command, "default", None)):
            name, rest = default, [name, *rest]
        command = command.commands[name]
    values: dict[str, Any] = command.make_context(name, rest).params
    return values
