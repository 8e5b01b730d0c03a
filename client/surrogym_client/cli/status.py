"""``surrogym status``: what the server holds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from surrogym_client.cli.options import AsJson, Server, Token, connect

if TYPE_CHECKING:
    from collections.abc import Sequence

    from surrogym_shared.wire import OutputFidelity, SurrogateSummary, SurrogateView

FIDELITY = (
    *("output", "confidence", "as in the paper", "tolerance", "coverage"),
    *("leave-one-out error", "within 1 deviation", "within 2"),
)


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("status")(command)


def command(
    surrogate: Annotated[str | None, typer.Argument(help="One surrogate. [default: all]")] = None,
    server: Server = None,
    token: Token = None,
    as_json: AsJson = False,
) -> None:
    """Show all surrogates, or one with its fidelity and its ledger of real steps.

    Example: surrogym status pendulum
    """
    from surrogym_client.cli.output import give

    with connect(server, token) as api:
        if surrogate is None:
            all_of_them = api.surrogates()
            listed = {"server": api.url, "surrogates": [s.model_dump(mode="json") for s in all_of_them]}
            give(listed, lambda: _table(all_of_them), as_json=as_json)
        else:
            view = api.surrogate(surrogate)
            give(view.model_dump(mode="json"), lambda: _detail(view), as_json=as_json)


def _table(surrogates: Sequence[SurrogateSummary]) -> str:
    from surrogym_client.cli.output import columns

    if not surrogates:
        return "no surrogates yet; next: surrogym register Pendulum-v1 --name pendulum"
    heading = ("name", "environment", "phase", "samples", "model", "confidence index")
    rows = [
        (
            s.name,
            s.environment or "own",
            "paused" if s.paused else s.phase,
            s.samples,
            s.model_version,
            s.confidence_index,
        )
        for s in surrogates
    ]
    return columns([heading, *rows])


def _detail(view: SurrogateView) -> str:
    from surrogym_client.cli.output import columns

    ledger = view.ledger
    lines = [
        f"{view.name}: {view.environment or 'own environment'}, {'paused, ' if view.paused else ''}{view.phase}",
        f"real steps: {ledger.initial} initial, {ledger.adaptive} adaptive, {ledger.manual} manual, "
        f"{ledger.total} of {view.budget} in all; {ledger.evaluation} in evaluation, {ledger.unresolved} unresolved",
        f"queries: {view.queries.pending} pending, {view.queries.leased} leased, {view.queries.set_aside} set aside",
    ]
    if view.error:
        lines.append(f"last error: {view.error}")
    if view.fidelity is not None:
        lines += [
            f"model {view.model_version}: confidence index {view.fidelity.confidence_index:.4f}, "
            f"target {view.target:g}; as the paper counts it {view.fidelity.confidence_index_paper:.4f}",
            columns([FIDELITY, *(_judged(output) for output in view.fidelity.outputs)]),
        ]
    return "\n".join(lines)


def _judged(output: OutputFidelity) -> tuple[str | float | None, ...]:
    return (
        *(output.name, output.confidence_index, output.confidence_index_paper, output.tolerance, output.coverage),
        *(output.leave_one_out_error, output.leave_one_out_within_one, output.leave_one_out_within_two),
    )
