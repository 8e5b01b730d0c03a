"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from surrogym_client.api import Api
    from surrogym_shared.spec import EnvironmentSpec

Server = Annotated[
    str | None,
    typer.Option("--server", envvar="SURROGYM_URL", help="Address of the server. [default: http://127.0.0.1:8000]"),
]
Token = Annotated[str | None, typer.Option("--token", envvar="SURROGYM_TOKEN", help="Bearer token of the server.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on standard output.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no remarks.")]
Wait = Annotated[float, typer.Option("--wait", min=0, help="Seconds to wait for what is not there yet.")]
ExitWithParent = Annotated[
    bool, typer.Option("--exit-with-parent", hidden=True, help="End when the process that started this one ends.")
]
SpecFile = Annotated[
    Path | None, typer.Option("--spec", help="JSON file with a specification, instead of the environment's own.")
]
Tolerances = Annotated[
    list[str] | None,
    typer.Option("--tolerance", help="Error an output may have, in its own unit, such as theta=0.01. May be repeated."),
]
StepLimit = Annotated[float, typer.Option(min=0.001, help="Seconds one real step, or a reset, may take.")]
Preset = Literal["default", "paper"]

QUICK = 1.0  # seconds a person waits for a server that is not there


def connect(server: str | None, token: str | None, wait: float = 0.0) -> Api:
    """The server, which must answer within ``wait`` seconds.

    Raises:
        SurrogymClientError: it does not, or it is none.
    """
    from surrogym_client.api import Api
    from surrogym_client.connection import Retries

    api = Api(server, token, retries=Retries(seconds=QUICK))
    if wait > 0:
        api.wait_until_ready(wait)
    return api


def read_spec(path: Path | None) -> EnvironmentSpec | None:
    """A specification from its file.

    Raises:
        OSError: it can't be read.
        CommandError: it is none, or contradicts itself.
    """
    if path is None:
        return None
    from pydantic import ValidationError

    from surrogym_client.cli.errors import CommandError, invalid
    from surrogym_shared.spec import EnvironmentSpec

    try:
        return EnvironmentSpec.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise CommandError(f"{path} is no specification: {invalid(error)}") from error


def read_tolerances(given: list[str]) -> dict[str, float]:
    """Tolerances by output, from ``output=number`` each.

    Raises:
        CommandError: one is not of this form.
    """
    from surrogym_client.cli.errors import CommandError

    tolerances: dict[str, float] = {}
    for text in given:
        name, _, number = text.partition("=")
        try:
            tolerances[name] = float(number)
        except ValueError as error:
            raise CommandError(f"--tolerance: expected output=number, such as theta=0.01, got {text!r}") from error
    return tolerances
