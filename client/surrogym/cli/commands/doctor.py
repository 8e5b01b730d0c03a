"""``surrogym doctor``: check the installation, the server and the environment."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from surrogym.cli.groups import Output, Service
from surrogym.cli.options import (
    NAMES,
    SpecFile,
    StepLimit,
    read_spec,
)
from surrogym.cli.printing import found_aside, prints_aside
from surrogym_shared.terminal import give, on_interrupt
from surrogym_shared.words import counted

if TYPE_CHECKING:
    from surrogym_sampler.diagnosis.doctor import Finding
    from surrogym_shared.spec import EnvironmentSpec


def command(
    context: typer.Context,
    env: Annotated[
        str | None,
        typer.Option(
            help=f"Also check this environment, by 18 real steps at most: {NAMES}. Without --spec, one that has no "
            "specification of its own is described first, by 400 real steps or more."
        ),
    ] = None,
    spec: SpecFile = None,
    step_limit: StepLimit = 30.0,
    history: Annotated[
        int,
        typer.Option(
            min=0,
            help="Take this many further real steps, to find dead time, encoders, friction, noise, and whether the "
            "environment needs earlier changes and actions as lags. 60 are enough for most.",
        ),
    ] = 0,
    *,
    service: Service,
    output: Output,
) -> None:
    """Check the installation, the server and an environment.

    The checks cover versions, server, token and round trip time. Each check prints one line; a problem's line says how
    to solve it. With --env, the command sets states and reads them back, and repeats steps and resets, to show how
    exact the environment is. The exit status is 1 if there is a problem. With --quiet, only problems and notes show.

    Example: surrogym doctor --env Pendulum-v1
    """
    from surrogym_sampler.diagnosis.doctor import installation
    from surrogym_sampler.diagnosis.doctor import service as findings_of

    def findings() -> Iterator[Finding]:
        given = read_spec(spec)
        yield from installation()
        with service.connect(context) as api:
            yield from findings_of(api)
        if env is not None:
            yield from _of_environment(env, given, step_limit, history)

    found: list[Finding] = []
    with on_interrupt(lambda: f"interrupted after {counted(len(found), 'check')}; no command counts their real steps"):
        for finding in findings():
            found.append(finding)
            told = finding.notable or finding.way_out is not None
            if not output.as_json and (told or not output.quiet):
                typer.echo(_line(finding))
    problems = sum(finding.way_out is not None for finding in found)
    if output.as_json:
        give({"problems": problems, "findings": [asdict(finding) for finding in found]}, str, as_json=True)
    if problems:
        raise typer.Exit(1)


def _of_environment(env: str, given: EnvironmentSpec | None, step_limit: float, history: int) -> Iterator[Finding]:
    """Yield the findings of the checks of an environment. Output of the environment goes to standard error."""
    from surrogym_sampler.diagnosis.doctor import environment
    from surrogym_sampler.original.loading import isolated

    if given is None:
        with prints_aside():
            given, words = _described(env)
        yield from words
        if any(word.name == "environment" for word in words):
            return
    yield from found_aside(environment(partial(isolated, env, step_limit, given), history))


def _described(env: str) -> tuple[EnvironmentSpec | None, list[Finding]]:
    """Draft a specification for an environment without one, by real steps, and return it with findings about it.

    The specification is None if the environment has its own, or if the draft failed.
    """
    from surrogym_sampler.diagnosis.doctor import NEEDS, Finding
    from surrogym_sampler.original.describing import describe
    from surrogym_sampler.original.errors import OriginalError
    from surrogym_sampler.original.loading import has_specification
    from surrogym_shared.spec import DeclaredReward, RewardTerm

    if has_specification(env):
        return None, []
    try:
        found = describe(env)
    except OriginalError as error:
        return None, [Finding("environment", str(error), NEEDS)]
    spec, lacking = found.spec, []
    if not found.pays:
        nothing = DeclaredReward(kind="declared", terms=(RewardTerm(weight=0.0, shape="one"),))
        spec = spec.model_copy(update={"reward": nothing})
        way_out = f"surrogym describe {env} > env.json; declare it in env.json, and give --spec env.json"
        lacking = [Finding("reward", "the environment has none, so the specification has to declare it", way_out)]
    words = (
        f"no built-in specification; described by {found.steps} real steps and {found.resets} resets (surrogym "
        f"describe {env})"
    )
    return spec, [Finding("spec", words), *lacking]


def _line(finding: Finding) -> str:
    if finding.way_out is not None:
        return f"problem  {finding.name:<11}  {finding.said}; {finding.way_out}"
    return f"{'note' if finding.notable else 'ok':<7}  {finding.name:<11}  {finding.said}"
