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


def test_the_fields_of_a_group_are_options_of_the_command():
    ended = CliRunner().invoke(app(), ["picture", "--width", "4", "-t", "5", "--loud"])
    assert ended.output == "4 picture Size(width=4, height=5) True\n"


def test_a_field_without_a_default_is_required_and_bounds_are_kept():
    runner = CliRunner()
    assert "Missing option '--width'" in runner.invoke(app(), ["picture"]).output
    assert "not in the range x>=1" in runner.invoke(app(), ["picture", "--width", "0"]).output


@pytest.mark.parametrize("name", sorted(set(COMMANDS) - WITHOUT_A_SERVER))
def test_every_command_that_asks_a_server_takes_it_in_the_same_way(name: str):
    command = command_line().commands[name]
    found = {parameter.name: parameter for parameter in command.params}
    assert found.keys() >= SHARED
    assert found["server"].envvar == "SURROGYM_URL"
    assert found["token_file"].opts == ["--token-file"]


def test_the_options_of_a_session_are_fields_of_its_opening():
    assert {field.name for field in fields(SessionOptions)} <= set(OpenSession.model_fields)
