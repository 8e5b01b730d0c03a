"""Options that several commands share, and the storage of policies on the server at the end of commands."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surrogym.cli.errors import CommandError
from surrogym_shared.terminal import on_interrupt, progress, say

if TYPE_CHECKING:
    from surrogym_client.transport.api import Api
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_shared.terminal import Update
    from surrogym_shared.wire import SurrogateView

SHOWN = (
    "warning: --token shows the token in the list of processes; SURROGYM_TOKEN, --token-file or SURROGYM_TOKEN_FILE "
    "keep it out of there"
)
NAMES = (  # forms of an environment's name, for the help of every command that opens an environment
    "a Gymnasium id, package:Id-v0, dm_control:DOMAIN-TASK, pcgym:MODEL, pcgym:FILE.json, fmu:PLANT.fmu, "
    "mujoco:FILE.xml, exec:COMMAND or package.module:factory"
)
LONGEST_SECONDS = 604_800.0  # a week: longest wait for a design on which a sampler is at work, or for a fit
QUICK = 1.0  # seconds to wait for a server in the first attempt, because it may not be running


def names_of_surrogates(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the surrogates whose names begin with ``incomplete``, for completion in the shell. Empty if no server
    answers within a second."""
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
    typer.Option("--server", envvar="SURROGYM_URL", help="URL of the server. [default: http://127.0.0.1:8000]"),
]
Token = Annotated[
    str | None,
    typer.Option(
        "--token",
        envvar="SURROGYM_TOKEN",
        help="Bearer token for the server. A token typed here shows in the list of processes. SURROGYM_TOKEN and "
        "--token-file keep it out of there.",
    ),
]
TokenFile = Annotated[
    Path | None, typer.Option("--token-file", envvar="SURROGYM_TOKEN_FILE", help="File that contains the bearer token.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on standard output.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress and no remarks.")]
TrustPolicy = Annotated[
    bool,
    typer.Option(
        "--trust-policy",
        help="Unpickle the objects in the policy file. This runs any code in the file. Policies of surrogym "
        "train don't need it.",
    ),
]
Wait = Annotated[
    float, typer.Option("--wait", min=0, help="Seconds to wait for a server or surrogate that is not there yet.")
]
TrainWait = Annotated[
    float | None,
    typer.Option(
        "--wait",
        min=0,
        help="Seconds to wait for the server, the surrogate and the end of its design. Without it, training waits for "
        "a design on which a sampler or a fit is at work; 0 does not wait.",
    ),
]
ExitWithParent = Annotated[
    bool, typer.Option("--exit-with-parent", hidden=True, help="End when the process that started this one ends.")
]
SpecFile = Annotated[
    Path | None,
    typer.Option("--spec", help="JSON file with a specification. It replaces the environment's own, or a log's draft."),
]
Tolerances = Annotated[
    list[str] | None,
    typer.Option(
        "--tolerance", help="Tolerance of an output, in its own unit, such as theta=0.01. May be given several times."
    ),
]
FallbackProgram = Annotated[
    str | None,
    typer.Option(
        "--fallback",
        metavar="NAME=MODULE:FUNCTION",
        help="Program of the fallback that the limits of the specification name: a function from the coordinates to an "
        "action.",
    ),
]
StepLimit = Annotated[float, typer.Option(min=0.001, help="Seconds that one real step, or one reset, may take.")]
# the entries at the top level of a file that surrogym describe writes
DESCRIBED = ("real_steps", "resets", "found", "asked", "specification")


def connect(server: str | None, token: str | None, wait: float = 0.0, *, quiet: bool = False) -> Api:
    """Connect to the server, and wait up to ``wait`` seconds until it answers. The terminal shows what the command
    waits for.

    Raises:
        SurrogymClientError: no server answered in time, or the answer is not that of a Surrogym server.
    """
    from surrogym_client.errors import ServerUnreachable
    from surrogym_client.transport.api import Api
    from surrogym_client.transport.connection import Retries

    api = Api(server, token, retries=Retries(seconds=QUICK))
    if wait > 0:
        try:
            api.wait_until_ready(QUICK)
        except ServerUnreachable:
            with waiting(f"for a server at {api.url}", quiet=quiet):
                api.wait_until_ready(wait)
    return api


def token_from(context: typer.Context, token: str | None, file: Path | None) -> str | None:
    """Return the bearer token. An option on the command line takes precedence over an environment variable. Between two
    environment variables, a token takes precedence over a token file.

    Warns on the terminal if other users of the machine can read the token.

    Raises:
        CommandError: --token and --token-file are both on the command line.
        UnusableToken: the file does not contain a token.
    """
    from surrogym_client.transport.connection import token_in
    from surrogym_shared.secret_files import open_to_others

    quiet, typed_file = bool(context.params.get("quiet")), given_here(context, "token_file")
    if given_here(context, "token"):
        if typed_file:
            raise CommandError("expected --token or --token-file, got both; give one of the two")
        say(SHOWN, quiet=quiet)
    if file is None or (token is not None and not typed_file):
        return token
    if warning := open_to_others(file):
        say(f"warning: {warning}", quiet=quiet)
    return token_in(file)


def awaited_surrogate(api: Api, name: str, wait: float, *, quiet: bool) -> SurrogateView:
    """Wait up to ``wait`` seconds until a surrogate is registered, and return it. The terminal shows what the command
    waits for.

    Raises:
        UnknownSurrogate: the surrogate was not registered in time.
    """
    from surrogym_client.errors import UnknownSurrogate
    from surrogym_client.surrogates.waiting import wait_for_surrogate

    try:
        return api.surrogate(name)
    except UnknownSurrogate:
        if wait == 0:
            raise
    with waiting(f"for {name!r} to be registered", quiet=quiet):
        return wait_for_surrogate(api, name, wait)


@contextmanager
def working(what: str, stays: str, *, quiet: bool) -> Iterator[Update]:
    """Context of a command's work, whose progress the terminal shows under the name ``what``. Yields the function that
    shows it. Ctrl-C prints ``stays``, which says what is kept."""
    with on_interrupt(lambda: stays), progress(what, quiet=quiet) as update:
        yield update


@contextmanager
def waiting(words: str, *, quiet: bool) -> Iterator[None]:
    with working("wait", "interrupted; the same command waits again", quiet=quiet) as update:
        update(None, words)
        yield


def await_model(
    server: str | None,
    token: str | None,
    surrogate: str,
    seconds: float,
    words: Callable[[SurrogateView, float], str],
    *,
    quiet: bool,
) -> SurrogateView:
    """Wait up to ``seconds`` until the server has fitted a model to all samples, and return the surrogate. The terminal
    shows the ``words`` for it and the seconds waited so far.

    Raises:
        DesignUnfinished: there is no such model in time.
        SurrogymClientError: the server does not answer, or has no such surrogate.
    """
    from surrogym_client.surrogates.waiting import wait_for_model

    stays = f"interrupted while the server fits the model; surrogym status {surrogate} shows it"
    with working("fit", stays, quiet=quiet) as update, connect(server, token) as api:
        began = time.monotonic()
        return wait_for_model(api, surrogate, seconds, lambda view: update(None, words(view, time.monotonic() - began)))


def first_model(api: Api, surrogate: str, *, quiet: bool) -> SurrogateView:
    """Return a surrogate. If its first model is being fitted, or is about to be, wait for it; the terminal says so.

    Raises:
        DesignUnfinished: the fit failed.
        SurrogymClientError: the server does not answer, or has no such surrogate.
    """
    from surrogym_client.surrogates.waiting import is_fitting, wait_for_model, words_of_design

    view = api.surrogate(surrogate)
    if view.model_version is not None or not is_fitting(view):
        return view
    with working("fit", "interrupted; the server continues to fit the model", quiet=quiet) as update:
        return wait_for_model(api, surrogate, LONGEST_SECONDS, lambda now: update(None, words_of_design(now)))


def given_here(context: typer.Context, name: str) -> bool:
    """Whether an option was given on the command line, and not by an environment variable or its default."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def typed(context: typer.Context, without: Sequence[str] = ()) -> str:
    """Return the arguments and options of this command line as text for a shell, except those named in ``without``."""
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


@dataclass(frozen=True)
class SpecContent:
    """Content of a file with a specification.

    Attributes:
        spec: the specification.
        steps: real steps that ``surrogym describe`` noted in the file; 0 in another file.
        content: the file's bytes.
    """

    spec: EnvironmentSpec
    steps: int
    content: bytes


def read_spec(path: Path | None) -> EnvironmentSpec | None:
    """Read a specification from a file, which may be the output of ``surrogym describe``; None for None. Raises the
    errors of ``read_spec_file``."""
    return None if path is None else read_spec_file(path).spec


def read_spec_file(path: Path) -> SpecContent:
    """Read a file with a specification. It is read only once, because it may be a pipe.

    Raises:
        OSError: the file can't be read.
        CommandError: the file is not a valid specification.
    """
    from pydantic import ValidationError

    from surrogym_shared.faults import first_fault
    from surrogym_shared.spec import EnvironmentSpec

    content = path.read_bytes()
    if not content.strip():
        raise CommandError(f"{path} is not a specification: it is empty; surrogym describe ENVIRONMENT writes one")
    try:
        read = json.loads(content)
        described = isinstance(read, dict) and "specification" in read
        if described and (beside := sorted(map(str, read.keys() - DESCRIBED))):
            raise CommandError(
                f"{path} is not a specification: expected only {', '.join(DESCRIBED)} at its top level, got "
                f"{beside[0]!r} as "
                "well; entries of a specification belong inside 'specification'"
            )
        spec = EnvironmentSpec.model_validate_json(json.dumps(read["specification"]) if described else content)
    except ValidationError as error:
        raise CommandError(
            f"{path} is not a specification: {first_fault(error, of=EnvironmentSpec)}; correct it and try again"
        ) from error
    except json.JSONDecodeError as error:
        raise CommandError(
            f"{path} is not a specification: expected JSON, got a fault in line {error.lineno}, column {error.colno} "
            f"({error.msg}); correct it and try again"
        ) from error
    except UnicodeDecodeError as error:
        raise CommandError(
            f"{path} is not a specification: expected JSON as text in UTF-8, got other bytes; write it again in UTF-8"
        ) from error
    except (ValueError, RecursionError) as error:
        raise CommandError(f"{path} is not a specification: {error}; correct it and try again") from error
    steps = read.get("real_steps") if isinstance(read, dict) else None
    return SpecContent(spec, steps if type(steps) is int and steps > 0 else 0, content)


def read_tolerances(given: list[str]) -> dict[str, float]:
    """Parse tolerances of the form ``output=number`` into a dictionary.

    Raises:
        CommandError: a text does not have this form.
    """
    tolerances: dict[str, float] = {}
    for text in given:
        name, _, number = text.partition("=")
        try:
            tolerances[name] = float(number)
        except ValueError as error:
            raise CommandError(f"--tolerance: expected output=number, such as theta=0.01, got {text!r}") from error
    return tolerances


def require_known(algorithm: str) -> str:
    """Return the registered spelling of the name of a policy search.

    Raises:
        CommandError: no policy search has this name.
    """
    from surrogym_trainer.training.search import SEARCHES

    try:
        return SEARCHES.name_of(algorithm)
    except ValueError as error:
        raise CommandError(str(error)) from error


def push_or_say(
    server: str | None, token: str | None, policy: Path, surrogate: str | None = None, *, quiet: bool = False
) -> int | None:
    """Store a policy and its waiting evaluations on the server, and return its version.

    An unreachable server must not spoil a training or an evaluation. So an error of the server is only printed, with
    the command that stores the policy later, and the result is None.
    """
    from surrogym_client.errors import SurrogymClientError
    from surrogym_trainer.policies.pushing import push

    try:
        with connect(server, token) as api:
            sent = push(api, policy, surrogate)
    except SurrogymClientError as error:
        say(
            f"the policy was not stored on the server: {error}; to store it later: surrogym policy push {policy}",
            quiet=quiet,
        )
        return None
    if sent.refused:
        say(f"the server did not take the video: {sent.refused}", quiet=quiet)
    say(f"stored on the server as {sent.surrogate}@{sent.policy.version}", quiet=quiet)
    return sent.policy.version
