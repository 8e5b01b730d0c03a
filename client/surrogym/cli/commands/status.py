"""``surrogym status``: show the surrogates on the server."""

from __future__ import annotations

import json
from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from surrogym.cli.columns import columns
from surrogym.cli.groups import Service
from surrogym.cli.options import AsJson, names_of_surrogates
from surrogym_shared.terminal import watch
from surrogym_shared.words import counted, visible

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from surrogym_client.transport.api import Api
    from surrogym_shared.wire import DirtFinding, ModelView, OutputFidelity, PolicyView, SurrogateSummary, SurrogateView

Form = Literal["json", "short", "words"]

FIDELITY = (
    *("output", "confidence", "as in the paper", "tolerance", "coverage"),
    *("leave-one-out error", "within 1 std", "within 2", "noise"),
)


def command(
    context: typer.Context,
    surrogate: Annotated[
        str | None, typer.Argument(help="Name of a surrogate. [default: all]", autocompletion=names_of_surrogates)
    ] = None,
    watching: Annotated[bool, typer.Option("--watch", "-w", help="Refresh the output until Ctrl-C.")] = False,
    as_json: AsJson = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Show names and phases only, without a heading.")
    ] = False,
    *,
    service: Service,
) -> None:
    """Show all surrogates, or the details of one.

    The details of a surrogate are its confidence index, errors and real steps. With --watch --json, each change is one
    line of JSON.

    Example: surrogym status pendulum --watch
    """
    form: Form = "json" if as_json else "short" if quiet else "words"
    with service.connect(context) as api:
        look = partial(_all, api, form) if surrogate is None else partial(_one, api, surrogate, form)
        # an unknown name or a wrong address is an error here; later, --watch tries again if the server does not answer
        seen = look()
        if watching:
            watch(partial(_patiently, look, as_json))
        else:
            typer.echo(json.dumps(json.loads(seen), indent=2) if as_json else visible(seen))


def _all(api: Api, form: Form) -> str:
    surrogates = api.surrogates()
    if form == "json":
        return json.dumps({"server": api.url, "surrogates": [s.model_dump(mode="json") for s in surrogates]})
    return "\n".join(map(_short, surrogates)) if form == "short" else _table(surrogates)


def _one(api: Api, name: str, form: Form) -> str:
    view = api.surrogate(name)
    if form == "json":
        found = {"dirt": [finding.model_dump() for finding in dirt]} if (dirt := _dirt(api, view)) else {}
        return json.dumps(view.model_dump(mode="json") | found)
    if form == "short":
        return _short(view)
    models = api.models(name) if view.phase in ("over_budget", "unsure") else ()
    said = [f"{finding.name}: {finding.said}" for finding in _dirt(api, view)]
    untrusted = _untrusted(name, api.policies.list(name))
    return "\n".join([_detail(view, models), *said, *_limits(api, view), *_prior(api, view), *untrusted])


def _dirt(api: Api, view: SurrogateView) -> list[DirtFinding]:
    """Return what ``surrogym doctor --history`` would name of the machine, found in the first real steps."""
    return api.dirt(view.name) if view.spec.access == "reset" else []


def _limits(api: Api, view: SurrogateView) -> list[str]:
    """Return lines on how all real steps kept the limits of the specification; empty without limits or steps."""
    return [] if view.spec.limits is None else api.limits(view.name)


def _prior(api: Api, view: SurrogateView) -> list[str]:
    """Return lines about the prior of a surrogate; empty if it has no prior and does not wait for one."""
    from surrogym.cli.commands.prior import words_of_prior, words_of_use
    from surrogym_client.transport.priors import PriorCalls

    stored, name = PriorCalls(api.connection).get(view.name), view.name
    if stored.awaited:
        return [
            f"the design waits for its prior; next: surrogym prior {name} SIMULATOR, or surrogym prior {name} --drop"
        ]
    return [] if stored.about is None else [*words_of_prior(stored.about), *words_of_use(view)]


def _untrusted(name: str, policies: Sequence[PolicyView]) -> list[str]:
    """Return a line for each policy whose promised return is not trusted, if it is the newest or has an alias."""
    shown = [one for number, one in enumerate(policies) if one.trusted is False and (one.aliases or number == 0)]
    named = [", ".join([f"{name}@{one.version}", *one.aliases]) for one in shown]
    return [f"policy {words}: not trusted: {one.reason}" for words, one in zip(named, shown, strict=True)]


def _patiently(look: Callable[[], str], as_json: bool) -> str:
    """Return the current output, or a remark that the server does not answer."""
    from surrogym_client.errors import ServerUnreachable

    try:
        return look()
    except ServerUnreachable as error:
        return json.dumps({"error": str(error)}) if as_json else f"{error}; trying again until Ctrl-C"


def _short(seen: SurrogateSummary) -> str:
    return f"{seen.name} {_phase(seen)}"


def _phase(seen: SurrogateSummary) -> str:
    return "paused" if seen.paused else seen.phase


def _table(surrogates: Sequence[SurrogateSummary]) -> str:
    if not surrogates:
        return "no surrogates yet; next: surrogym register Pendulum-v1 --name pendulum"
    heading = ("name", "environment", "phase", "real steps", "queries", "model", "confidence index", "target")
    return columns([heading, *map(_row, surrogates)])


def _row(seen: SurrogateSummary) -> tuple[str | float | None, ...]:
    queries = seen.queries
    waiting = f"{queries.pending} pending, {queries.leased} leased" if queries.pending + queries.leased else "none"
    steps = _steps(seen)
    environment = seen.environment or "own"
    return (
        *(seen.name, environment, _phase(seen), steps, waiting),
        *(seen.model_version, seen.confidence_index, f"{seen.target:g}"),
    )


def _detail(view: SurrogateView, models: Sequence[ModelView]) -> str:
    from surrogym_client.surrogates.advice import advice, noise_in_words, verdict

    ledger = view.ledger
    lines = [
        f"{view.name}: {view.environment or 'own environment'}{_period(view)}, "
        f"{'paused, ' if view.paused else ''}{view.phase}",
        f"real steps: {_steps(view)}",
        f"in the budget: {ledger.initial} initial, {ledger.adaptive} adaptive, {ledger.manual} manual",
        f"without an answer, also in audits: {ledger.unresolved} unresolved ({ledger.failed} failed)",
        *_given(view),
        f"queries: {view.queries.pending} pending, {view.queries.leased} leased, {view.queries.set_aside} set aside",
    ]
    if view.queries.set_aside:
        lines[-1] += f" because they failed; surrogym change {view.name} --resume queues those of the design again"
    if view.queries.refused:
        lines[-1] += f"; {view.queries.refused} refused by the environment, which took no real step of the budget"
    if hint := _hint(view):
        lines.append(hint)
    if view.error:
        lines.append(f"last error: {view.error}")
    if view.fidelity is not None:
        lines += [
            f"model {view.model_version}: confidence index {view.fidelity.confidence_index:.4f}, "
            f"target {view.target:g}; as the paper counts it {view.fidelity.confidence_index_paper:.4f}",
            columns([FIDELITY, *(_judged(output) for output in view.fidelity.outputs)]),
            f"verdict: {verdict(view)}",
        ]
    if noise := noise_in_words(view):
        lines.append(f"noise of a single step, confirmed by real steps: {noise}")
    if following := advice(view, models):
        lines.append(f"next: {following}")
    return "\n".join(lines)


def _given(view: SurrogateView) -> list[str]:
    """Return a line on what the machine gave beside real steps: resets, seconds and wear; empty before a real step."""
    ledger = view.ledger
    if not ledger.total + ledger.audit:
        return []
    seconds = [] if view.machine_seconds is None else [f"{view.machine_seconds:.4g} s without resets"]
    bound = f"{counted(ledger.wear, 'step')} at a bound of the action"
    return [f"of the machine: {', '.join([counted(ledger.resets, 'reset'), *seconds, bound])}"]


def _period(view: SurrogateView) -> str:
    """Return the declared sampling period as the end of a sentence, ", a step every 0.1 s"; empty without one."""
    period = view.spec.sampling_period
    return "" if period is None else f", a step every {period:g} s"


def _steps(seen: SurrogateSummary) -> str:
    """Describe how many real steps of the budget were taken, and those that the budget does not include: of audits, of
    evaluations and from logs."""
    ledger = seen.ledger
    taken = [f"{ledger.total} of {seen.budget}"] if seen.budget or ledger.total else []
    besides = {"of audits": ledger.audit, "of evaluations": ledger.evaluation, "logged": ledger.logged}
    return ", ".join([*taken, *(f"{count} {what}" for what, count in besides.items() if count)]) or "none"


def _hint(view: SurrogateView) -> str | None:
    """Return the next step if the surrogate waits for an action of the user; else None."""
    from surrogym_client.surrogates.waiting import awaits_log, words_of_no_log
    from surrogym_sampler.original.loading import sample_command

    if view.phase == "from_log":
        return (
            f"the model is fitted to the log, and the design requests no real steps; next: surrogym train {view.name}"
        )
    if awaits_log(view):
        return words_of_no_log(view.name)
    if view.queries.pending and not view.samplers and not view.paused:
        logged = "; until then, the model of the log is served" if view.ledger.logged and view.model_version else ""
        start = sample_command(view.name, view.environment)
        return f"{view.queries.pending} queries wait for a sampler{logged}; next: {start}"
    return None


def _judged(output: OutputFidelity) -> tuple[str | float | None, ...]:
    return (
        *(output.name, output.confidence_index, output.confidence_index_paper, output.tolerance, output.coverage),
        *(output.leave_one_out_error, output.leave_one_out_within_one, output.leave_one_out_within_two, output.noise),
    )
