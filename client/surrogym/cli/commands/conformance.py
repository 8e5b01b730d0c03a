"""``surrogym conformance``: check that a server, or a program, follows its protocol."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated

import typer

from surrogym.cli.groups import Output, Service
from surrogym.cli.options import StepLimit
from surrogym_shared.terminal import on_interrupt
from surrogym_shared.words import visible

if TYPE_CHECKING:
    from surrogym_sampler.diagnosis.outcomes import Outcome


def command(
    context: typer.Context,
    surrogate: Annotated[
        str,
        typer.Option("--surrogate", help="Name for a temporary surrogate, not yet in use. It is deleted at the end."),
    ] = "conformance",
    program: Annotated[
        str | None,
        typer.Option("--exec", metavar="COMMAND", help="Program to check in place of a server. It takes real steps."),
    ] = None,
    step_limit: StepLimit = 30.0,
    *,
    service: Service,
    output: Output,
) -> None:
    """Check that a server or a program follows its protocol.

    Each check prints one line. The exit status is 1 if a check fails. With --quiet, only failed checks are shown. With
    --exec, no server is needed, and the line of a failed check says how to solve it.

    Example: surrogym conformance --server http://127.0.0.1:8000

    Example: surrogym conformance --exec "./plant --port 7"
    """
    if program is not None:
        from surrogym_sampler.diagnosis import executables

        with on_interrupt(lambda: "interrupted; the program was ended"):
            _show(executables.conformance(program, step_limit), output)
        return
    from surrogym_sampler.diagnosis.conformance import conformance

    with on_interrupt(lambda: f"interrupted; {surrogate!r} was deleted"):
        _show(conformance(service.server, service.token_for(context), surrogate), output)


def _show(checked: Iterable[Outcome], output: Output) -> None:
    """Print the outcome of each check as soon as it is known, then the number of passed checks."""
    outcomes = []
    for outcome in checked:
        outcomes.append(outcome)
        if not output.as_json and (outcome.failure or not output.quiet):
            typer.echo(visible(_line(outcome)))
    failed = {outcome.name: outcome.failure for outcome in outcomes if outcome.failure}
    left_out = {outcome.name: outcome.left_out for outcome in outcomes if outcome.left_out}
    made = len(outcomes) - len(left_out)
    result = {"passed": made - len(failed), "failed": failed, "left_out": left_out}
    apart = f", {len(left_out)} left out" if left_out else ""
    output.give(result, lambda: f"{result['passed']} of {made} checks passed{apart}")
    if failed:
        raise typer.Exit(1)


def _line(outcome: Outcome) -> str:
    if outcome.failure:
        return f"✗ {outcome.name}: {outcome.failure}"
    return f"- {outcome.name}: left out, {outcome.left_out}" if outcome.left_out else f"✓ {outcome.name}"
