"""``surrogym register``: register an original environment with the server."""

from __future__ import annotations

import hashlib
import re
import shlex
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surrogym.cli.errors import CommandError, invalid
from surrogym.cli.groups import Output, Service
from surrogym.cli.options import (
    NAMES,
    SpecFile,
    Tolerances,
    Wait,
    read_spec_file,
    read_tolerances,
)
from surrogym.cli.printing import prints_aside, unregistered
from surrogym_shared.environments import is_name
from surrogym_shared.kinds import Access
from surrogym_shared.presets import PresetName
from surrogym_shared.terminal import say
from surrogym_shared.words import counted

if TYPE_CHECKING:
    from surrogym_client.transport.api import Api
    from surrogym_sampler.original.protocol import Environment
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_shared.wire import SurrogateView


@dataclass(frozen=True)
class DesignChoices:
    """Options that replace entries of the environment's own specification. An option that is None keeps the entry."""

    preset: Annotated[
        PresetName | None,
        typer.Option(
            help="Settings of the method: default, or paper for the method as published. [default: from the "
            "specification]"
        ),
    ] = None
    budget: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Maximum number of real steps that the design may take; 0 if all samples come from a log. [default: "
            "from the specification]",
        ),
    ] = None
    initial: Annotated[
        int | None,
        typer.Option(min=2, help="Number of real steps before the first model. [default: from the specification]"),
    ] = None
    target: Annotated[
        float | None,
        typer.Option(help="Confidence index to reach, between 0.5 and 1. [default: from the specification]"),
    ] = None
    acquisition: Annotated[
        str | None,
        typer.Option(
            help="Criterion that chooses queries after the first model: integrated_variance, variance, "
            "uncertainty_index, latin_hypercube, or one that a package on the server adds. [default: from the preset]"
        ),
    ] = None
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the design. [default: from the specification]")] = (
        None
    )
    bins: Annotated[
        int | None,
        typer.Option(
            min=2, help="Offer each continuous action to policies as this many discrete values. [default: continuous]"
        ),
    ] = None
    access: Annotated[
        Access | None,
        typer.Option(
            help="Where a query may begin. any: at any state, to which the environment is set. snapshot: at a state "
            "that was visited and saved, or at a reset. reset: at a reset only. [default: from the specification]"
        ),
    ] = None
    max_rollout: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="If not any state can be set: maximum number of actions in one query. [default: from the "
            "specification]",
        ),
    ] = None


PrintSpec = Annotated[
    bool,
    typer.Option(
        "--print-spec",
        help="Print the specification, and register nothing. If it has to be drafted, this takes real steps.",
    ),
]


def command(
    context: typer.Context,
    environment: Annotated[
        str | None,
        typer.Argument(
            help=f"Environment: {NAMES}. With --env or FILE, this argument is the surrogate's name instead."
        ),
    ] = None,
    file: Annotated[
        Path | None, typer.Argument(help="Specification that surrogym describe wrote; the same as --spec.")
    ] = None,
    env: Annotated[str | None, typer.Option(help="Environment, if the first argument is the surrogate's name.")] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the surrogate. [default: derived from the environment's name]")
    ] = None,
    spec: SpecFile = None,
    *,
    choices: DesignChoices,
    tolerance: Tolerances = None,
    print_spec: PrintSpec = False,
    wait: Wait = 0.0,
    service: Service,
    output: Output,
) -> None:
    """Register an original environment under a name.

    Samplers and trainers use this name. If the environment has no built-in specification, the command first drafts one
    as surrogym describe does, which takes real steps. The server counts these steps, and those of surrogym describe.

    Example: surrogym register Pendulum-v1 --name pendulum --budget 30
    """
    environment, name, spec = _sorted_out(environment, file, env, name, spec)
    read = None if spec is None else read_spec_file(spec)
    given, steps = (None, 0) if read is None else (read.spec, read.steps)
    with unregistered(lambda: 0 if read else steps, "nothing was registered"):
        if given is None and environment is not None and _lacks_specification(environment):
            if not print_spec:
                with service.connect(context, wait, quiet=output.quiet) as api:
                    _require_free(api, name or default_name(environment))
            given, steps = _described(environment, quiet=output.quiet)
        with prints_aside():
            chosen = _specification(environment, given, **vars(choices))
    if tolerance:
        chosen = _with_tolerances(chosen, read_tolerances(tolerance))
    if print_spec:
        typer.echo(chosen.model_dump_json(indent=2))
        return
    name = name or default_name(chosen.environment or environment or "")
    if environment is not None:
        chosen = _opened_by(environment, chosen)
    with service.connect(context, wait, quiet=output.quiet) as api:
        view = api.create_surrogate(name, chosen)
        if steps:
            key = None if read is None else _key(view.name, read.content)
            api.report_steps(view.name, steps, note="description", idempotency_key=key)
    output.give(view.model_dump(mode="json"), lambda: _words(view, environment or "", spec))


def _sorted_out(
    environment: str | None, file: Path | None, env: str | None, name: str | None, spec: Path | None
) -> tuple[str | None, str | None, Path | None]:
    """Return the environment, the surrogate's name and the specification file, from the arguments of the command.

    The first argument is the environment. With ``--env`` or a file as the second argument, it is the surrogate's name.
    """
    if file is not None:
        if spec is not None:
            raise CommandError(
                f"expected one specification, got the argument {file} and --spec {spec}: leave one out, and give the "
                "environment by --env"
            )
        spec = file
    if file is None and env is None:
        return environment, name, spec
    if environment is not None and name is not None:
        raise CommandError(f"expected one name, got {environment!r} and --name {name!r}; leave one out")
    return env, environment or name, spec


def _lacks_specification(environment: str) -> bool:
    """Whether an environment has no built-in specification, so that one has to be drafted. Raises an error if the
    environment can't be opened."""
    from surrogym_sampler.original.adapters import open_simulator
    from surrogym_sampler.original.loading import has_specification

    if has_specification(environment):
        return False
    with prints_aside():
        open_simulator(environment).close()
    return True


def _key(name: str, described: bytes) -> str:
    """Return the idempotency key for reporting the real steps with which a specification was drafted, so that
    registering the same file (``described``) twice counts them once."""
    return hashlib.sha256(name.encode() + b"\n" + described).hexdigest()[:32]


def _require_free(api: Api, name: str) -> None:
    """Check that no surrogate has this name, before a specification is drafted by real steps.

    Raises:
        CommandError: a surrogate has this name.
    """
    from surrogym_client.errors import UnknownSurrogate

    with suppress(UnknownSurrogate):
        api.surrogate(name)
        raise CommandError(
            f"a surrogate named {name!r} exists already, and no real step was taken; choose another name, or delete it "
            f"with surrogym delete {name}"
        )


def _described(environment: str, *, quiet: bool) -> tuple[EnvironmentSpec, int]:
    """Draft an environment's specification by real steps. Return it with the number of these steps."""
    from surrogym_sampler.original.describing import describe

    with prints_aside():
        description = describe(environment)
    for line in description.words():
        say(line, quiet=quiet)
    return description.spec, description.steps


def default_name(environment: str) -> str:
    """Derive a surrogate's name from an environment's name: ``Pendulum-v1`` becomes ``pendulum``."""
    plain = re.sub(r"-v\d+$", "", environment.rpartition(":")[2])
    return re.sub(r"[^a-z0-9._-]+", "-", plain.lower()).strip("-._")[:64] or "surrogate"


def _specification(environment: str | None, spec: EnvironmentSpec | None, **choices: object) -> EnvironmentSpec:
    from surrogym_sampler.original.loading import make, with_choices

    given = {key: value for key, value in choices.items() if value is not None}
    try:
        if environment is not None:
            original = make(environment, spec=spec, **given)  # type: ignore[arg-type]
            try:
                return original.spec()
            finally:
                _close(original, environment)
        if spec is not None:
            others = {name: given.pop(name) for name in ("bins", "access", "max_rollout") if name in given}
            return with_choices(spec, given, **others)  # type: ignore[arg-type]
    except ValueError as error:
        raise CommandError(invalid(error)) from error
    raise CommandError("expected an environment or --spec FILE, got neither: for example surrogym register Pendulum-v1")


def _close(original: Environment, name: str) -> None:
    """Close an environment that was opened for its specification. An error of its ``close`` is only printed, because
    the specification is valid nevertheless."""
    from surrogym_sampler.original.errors import sentence

    try:
        original.close()
    except Exception as error:
        say(f"{name} could not be closed: {sentence(error)}")


def _opened_by(environment: str, spec: EnvironmentSpec) -> EnvironmentSpec:
    """Return the specification with the environment's name in place of free text about it, so that commands that are
    suggested later can contain the name."""
    from surrogym_sampler.original.executables import is_executable

    # the command line of a program is not sent to the server
    if is_name(spec.environment) or is_executable(environment):
        return spec
    return spec.model_copy(update={"environment": environment})


def _with_tolerances(spec: EnvironmentSpec, tolerances: dict[str, float]) -> EnvironmentSpec:
    try:
        return type(spec).model_validate(spec.model_dump() | {"tolerances": spec.tolerances | tolerances})
    except ValueError as error:
        raise CommandError(invalid(error)) from error


def _words(view: SurrogateView, environment: str, file: Path | None) -> str:
    from surrogym_client.surrogates.waiting import awaits_log, words_of_no_log
    from surrogym_sampler.original.loading import is_known, sample_command
    from surrogym_shared.spec.safety import NamedFallback

    registered = (
        f"{view.name}: {view.environment or 'own environment'}, {counted(len(view.spec.coordinates), 'coordinate')}"
    )
    if awaits_log(view):
        return f"{registered}; {words_of_no_log(view.name)}"
    start = sample_command(view.name, view.environment)
    if environment:  # the suggested command repeats the name that the user gave, if a sampler needs it
        start = f"surrogym sample {view.name}" + ("" if is_known(environment) else f" --env {shlex.quote(environment)}")
    # a sampler runs only with a specification of its own that declares the same limits and lags
    lagging = any(coordinate.lag is not None for coordinate in view.spec.coordinates)
    if file is not None and (lagging or view.spec.limits is not None):
        start += f" --spec {shlex.quote(str(file))}"
    if view.spec.limits is not None and isinstance(view.spec.limits.fallback, NamedFallback):
        start += f" --fallback {view.spec.limits.fallback.name}=package.module:function"
    return f"{registered}, budget of {view.budget} real steps, target {view.target:g}; next: {start}"
