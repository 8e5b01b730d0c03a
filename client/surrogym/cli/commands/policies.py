"""``surrogym policies``: list the policies that the server stores."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from surrogym.cli.columns import columns
from surrogym.cli.groups import Output, Service
from surrogym.cli.options import names_of_surrogates

if TYPE_CHECKING:
    from surrogym_shared.wire import EvaluationView, PolicyView

HEADING = ("policy", "aliases", "algorithm", "promise", "trusted", "real return (95 %)", "success", "files")


def command(
    context: typer.Context,
    surrogate: Annotated[
        str | None, typer.Argument(help="Name of the surrogate. [default: all]", autocompletion=names_of_surrogates)
    ] = None,
    *,
    service: Service,
    output: Output,
) -> None:
    """List the policies that the server stores, newest first.

    Each row has the policy's aliases, promised return, real return and files.

    Example: surrogym policies pendulum
    """
    with service.connect(context) as api:
        names = [surrogate] if surrogate is not None else [one.name for one in api.surrogates()]
        found = {name: api.policies.list(name) for name in names}
    result = {name: [policy.model_dump(mode="json") for policy in policies] for name, policies in found.items()}
    output.give({"policies": result}, lambda: _table([(name, one) for name in names for one in found[name]]))


def _table(rows: Sequence[tuple[str, PolicyView]]) -> str:
    if not rows:
        return "no policies yet; next: surrogym train SURROGATE, or surrogym policy push POLICY"
    return columns([HEADING, *(_row(name, policy) for name, policy in rows)])


def _row(name: str, policy: PolicyView) -> tuple[str, ...]:
    from surrogym_trainer.policies.evidence import chosen_real

    real = chosen_real(policy)
    promise, trusted = policy.promise, {True: "yes", False: "no", None: "not judged"}[policy.trusted]
    return (
        f"{name}@{policy.version}",
        ", ".join(policy.aliases) or "-",
        policy.algorithm or "-",
        "-" if promise is None else f"{promise.low:.4g} to {promise.high:.4g}",
        trusted,
        _real(real),
        "-" if real is None or real.success_rate is None else f"{real.success_rate:.0%}",
        ", ".join(file.form for file in policy.files if file.stored) or "missing",
    )


def _real(evaluation: EvaluationView | None) -> str:
    """Describe the mean return of an evaluation, with a remark if the promised return is for other starts of episodes;
    "-" without an evaluation."""
    if evaluation is None:
        return "-"
    return words_of_mean(evaluation) + ("" if evaluation.declared else "; the promise is for others")


def words_of_mean(evaluation: EvaluationView) -> str:
    """Describe the mean return of an evaluation with its 95 % interval."""
    interval = evaluation.mean_interval
    about = "" if interval is None else f" ({interval.low:.4g} to {interval.high:.4g})"
    return f"{evaluation.mean:.4g}{about}"
