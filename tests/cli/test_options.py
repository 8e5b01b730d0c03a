"""What a hint repeats of a command line: all that was typed, but what it says otherwise and what is secret."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from surrogym.cli.errors import CommandError
from surrogym.cli.options import Quiet, Token, typed
from surrogym.cli.train_options import SearchOptions, SessionOptions


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("pendulum", "pendulum"),
        ("--steps 9 pendulum -q --no-loud", "pendulum --steps 9 --no-loud --quiet"),
        ("pendulum --set a=1 --set 'b=x y' --token secret -o p.zip", "pendulum --set a=1 --set 'b=x y'"),
    ],
)
def test_a_recommended_command_repeats_the_typed_options_without_secrets(line: str, said: str):
    app = typer.Typer()

    @app.command()
    def command(
        context: typer.Context,
        name: str,
        out: Annotated[Path, typer.Option("--out", "-o")] = Path("policy.zip"),
        chosen: Annotated[list[str] | None, typer.Option("--set")] = None,
        steps: int | None = None,
        loud: Annotated[bool | None, typer.Option("--loud/--no-loud")] = None,
        token: Token = None,
        quiet: Quiet = False,
    ) -> None:
        assert (name, out.suffix, quiet) == ("pendulum", ".zip", "-q" in line)
        typer.echo(typed(context, without=("out", "token")))

    again = CliRunner().invoke(app, line)
    assert again.exception is None
    assert again.output == said + "\n"


def test_a_planner_takes_no_number_of_virtual_steps():
    with pytest.raises(CommandError, match=r"expected no virtual steps with --algorithm planner, .* got 100"):
        SearchOptions(algorithm="planner", steps=100).hyperparameters()
    assert SearchOptions(algorithm="planner").hyperparameters() == {}


def test_limits_are_a_setting_of_the_planner_alone():
    options = SearchOptions(algorithm="Planner", limits=["level<=11", "x+v>=1"], chosen=["horizon=20"])
    assert options.hyperparameters() == {"horizon": 20, "limits": ["level<=11", "x+v>=1"]}
    with pytest.raises(CommandError, match=r"--limit: expected --algorithm planner, .* got another search"):
        SearchOptions(limits=["level<=11"]).hyperparameters()


def test_set_points_are_session_options_of_a_training():
    assert SessionOptions(set_points=["level=12", "a=b=-1.5"]).fields() == {"set_points": {"level": 12.0, "a=b": -1.5}}
    assert SessionOptions().fields() == {}


@pytest.mark.parametrize("given", ["level", "level=", "level=high", "=", ""])
def test_a_set_point_that_is_no_pair_of_coordinate_and_value_is_refused(given: str):
    with pytest.raises(CommandError, match="--set-point: expected COORDINATE=VALUE, such as level=12, got"):
        SessionOptions(set_points=[given]).fields()


def test_two_set_points_of_one_coordinate_are_refused():
    with pytest.raises(CommandError, match="--set-point: expected one value for each coordinate, got two for level"):
        SessionOptions(set_points=["level=12", "flow=1", "level=13"]).fields()
