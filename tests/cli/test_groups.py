"""Options in groups: one place for each, the same command line as without."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from support.commands import command_line
from surrogym.cli import COMMANDS
from surrogym.cli.groups import add
from surrogym.cli.train_options import SessionOptions
from surrogym_shared.wire import OpenSession

SHARED = {"server", "token", "token_file"}
WITHOUT_A_SERVER = {"describe", "export-policy", "demo", "policy"}  # or commands in a group of their own


@dataclass(frozen=True)
class Size:
    width: Annotated[int, typer.Option(min=1, help="Pixels.")]
    height: Annotated[int, typer.Option("--tall", "-t")] = 3


def app() -> typer.Typer:
    made = typer.Typer()

    def command(context: typer.Context, name: str, *, size: Size, loud: bool = False) -> None:
        """Say it."""
        typer.echo(f"{context.params['width']} {name} {size} {loud}")

    add(made, "draw", command)
    return made


def test_fields_of_an_option_group_become_options_of_the_command():
    ended = CliRunner().invoke(app(), ["picture", "--width", "4", "-t", "5", "--loud"])
    assert ended.output == "4 picture Size(width=4, height=5) True\n"


def test_an_option_group_field_without_default_is_a_required_option():
    runner = CliRunner()
    assert "Missing option '--width'" in runner.invoke(app(), ["picture"]).output
    assert "not in the range x>=1" in runner.invoke(app(), ["picture", "--width", "0"]).output


@pytest.mark.parametrize("name", sorted(set(COMMANDS) - WITHOUT_A_SERVER))
def test_every_command_that_uses_a_server_has_the_same_server_options(name: str):
    command = command_line().commands[name]
    found = {parameter.name: parameter for parameter in command.params}
    assert found.keys() >= SHARED
    assert found["server"].envvar == "SURROGYM_URL"
    assert found["token_file"].opts == ["--token-file"]


def test_session_options_of_the_command_line_are_fields_of_the_open_request():
    assert {field.name for field in fields(SessionOptions)} <= set(OpenSession.model_fields)
