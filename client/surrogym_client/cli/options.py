"""Options that several commands share."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from surrogym_client.transport.api import Api
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_shared.wire import SurrogateView

SHOWN = (
    "warning: --token shows the token in the list of processes; SURROGYM_TOKEN, --token-file or SURROGYM_TOKEN_FILE "
    "keep it out of there"
)
QUICK = 1.0  # seconds a person waits for a server that is not there


def names_of_surrogates(ctx: typer.Context, incomplete: str) -> list[str]:
    """What a shell completes a surrogate's name to; nothing where no server answers within a second."""
    from surrogym_client.errors import SurrogymClientError
    from surrogym_client.transport.api import Api
    from surrogym_client.transport.connection import Retries, Timeouts, token_in

    limits, at_once = Timeouts(connect=QUICK, request=QUICK), Retries(seconds=0)
    try:
        token = ctx.params.get("token") or (token_in(file) if (file := ctx.params.get("token_file")) else None)
        with Api(ctx.params.get("server"), token, timeouts=limits, retries=at_once) as api:
            return [surrogate.name for surrogate in api.surrogates() if surrogate.name.startswith(incomplete)]
    except SurrogymClientError:
        return []


Surrogate = Annotated[str, typer.Argument(help="Name of the surrogate.", autocompletion=names_of_surrogates)]
Server = Annotated[
    str | None,
    typer.Option("--server", envvar="SURROGYM_URL", help="Address of the server. [default: http://127.0.0.1:8000]"),
]
Token = Annotated[
    str | None,
    typer.Option(
        "--token",
        envvar="SURROGYM_TOKEN",
        help="Bearer token of the server. Typed here it shows in the list of processes; the variable and --token-file "
        "don't show it.",
    ),
]
TokenFile = Annotated[
    Path | None, typer.Option("--token-file", envvar="SURROGYM_TOKEN_FILE", help="File with the bearer token.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on standard output.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no remarks.")]
TrustPolicy = Annotated[
    bool,
    typer.Option(
        "--trust-policy",
        "--trust",
        help="Unpickle the policy's objects. This runs any code in the file. Policies of surrogym train don't need it.",
    ),
]
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


def connect(server: str | None, token: str | None, wait: float = 0.0, *, quiet: bool = False) -> Api:
    """The server, which must answer within ``wait`` seconds; a person sees what is waited for.

    Raises:
        SurrogymClientError: it does not, or it is none.
    """
    from surrogym_client.errors import ServerUnreachable
    from surrogym_client.transport.api import Api
    from surrogym_client.transport.connection import Retries

    api = Api(server, token, retries=Retries(seconds=QUICK))
    if wait > 0:
        try:
            api.wait_until_ready(QUICK)
        except ServerUnreachable:
            with _waiting(f"for a server at {api.url}", quiet=quiet):
                api.wait_until_ready(wait)
    return api


def token_from(context: typer.Context, token: str | None, file: Path | None) -> str | None:
    """The bearer token: what was typed comes before the environment, and there the token before its file.

    A person is told what shows the token to others.

    Raises:
        CommandError: both were typed.
        UnusableToken: the file does not hold one.
    """
    from surrogym_client.cli.errors import CommandError
    from surrogym_client.transport.connection import token_in
    from surrogym_shared.secret_files import open_to_others
    from surrogym_shared.terminal import say

    quiet, typed_file = bool(context.params.get("quiet")), given_here(context, "token_file")
    if given_here(context, "token"):
        if typed_file:
            raise CommandError("expected --token or --token-file, got both")
        say(SHOWN, quiet=quiet)
    if file is None or (token is not None and not typed_file):
        return token
    if warning := open_to_others(file):
        say(f"warning: {warning}", quiet=quiet)
    return token_in(file)


def awaited_surrogate(api: Api, name: str, wait: float, *, quiet: bool) -> SurrogateView:
    """The surrogate, which must be registered within ``wait`` seconds; a person sees what is waited for.

    Raises:
        UnknownSurrogate: it is not.
    """
    from surrogym_client.errors import UnknownSurrogate
    from surrogym_client.surrogates.waiting import wait_for_surrogate

    try:
        return api.surrogate(name)
    except UnknownSurrogate:
        if wait == 0:
            raise
    with _waiting(f"for {name!r} to be registered", quiet=quiet):
        return wait_for_surrogate(api, name, wait)


@contextmanager
def _waiting(words: str, *, quiet: bool) -> Iterator[None]:
    from surrogym_shared.terminal import on_interrupt, progress

    with on_interrupt(lambda: "interrupted; the same command waits again"), progress("wait", quiet=quiet) as update:
        update(None, words)
        yield


def given_here(context: typer.Context, name: str) -> bool:
    """Whether a person gave an option on this command line, and not by the environment."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def typed(context: typer.Context, without: Sequence[str] = ()) -> str:
    """The arguments and options that were given on the command line, but some, as they are typed."""
    words: list[str] = []
    for parameter in context.command.params:
        name = str(parameter.name)
        if name in without or not given_here(context, name):
            continue
        value = context.params[name]
        if parameter.param_type_name == "argument":
            words.append(str(value))
        elif isinstance(value, bool):
            words.append((parameter.opts if value else parameter.secondary_opts)[0])
        else:
            for one in value if isinstance(value, list | tuple) else [value]:
                words += [parameter.opts[0], str(one)]
    return shlex.join(words)


def read_spec(path: Path | None) -> EnvironmentSpec | None:
    """A specification from its file, or from what ``surrogym describe`` wrote.

    Raises:
        OSError: it can't be read.
        CommandError: it is none, or contradicts itself.
    """
    if path is None:
        return None
    from pydantic import ValidationError

    from surrogym_client.cli.errors import CommandError, invalid
    from surrogym_shared.spec import EnvironmentSpec

    content = path.read_bytes()
    try:
        read = json.loads(content)
        if isinstance(read, dict) and "specification" in read:
            return EnvironmentSpec.model_validate_json(json.dumps(read["specification"]))
        return EnvironmentSpec.model_validate_json(content)
    except ValidationError as error:
        raise CommandError(f"{path} is no specification: {invalid(error)}") from error
    except ValueError as error:
        raise CommandError(f"{path} is no specification: {error}") from error


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


def require_known(algorithm: str) -> None:
    """Refuse an unknown policy search before anything begins."""
    from surrogym_client.cli.errors import CommandError
    from surrogym_client.training.search import SEARCHES

    try:
        SEARCHES.name_of(algorithm)
    except ValueError as error:
        raise CommandError(str(error)) from error
