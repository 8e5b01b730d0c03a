"""The section of the report about real steps: each purpose has a line, and the lines add up to the total."""

from __future__ import annotations

from surrogym_shared.wire import Controller, SurrogateView
from surrogym_shared.words import counted
from surrogym_trainer.report.html import paragraph, section, table
from surrogym_trainer.report.known import Known
from surrogym_trainer.report.wording import starts_of, steps

ACTING: dict[Controller, str] = {
    "policy": "the controller",
    "zero": "no controller (an action of zero all the time)",
    "random": "no controller (random actions)",
    "reference": "the reference controller",
}


def cost(known: Known) -> str:
    """Return the report's section about the number of real steps, as HTML."""
    ledger, policy = known.view.ledger, known.policy
    counted = [(name, count) for name, count in purposes(known) if count]
    rows = [*counted, ("all together", sum(count for _, count in counted))]
    said = [
        table(("real steps for", "steps"), [(name, f"{count:,}") for name, count in rows], "What was done in reality"),
        paragraph(plan(known.view)),
    ]
    if policy is not None and policy.virtual_steps:
        said.append(
            paragraph(
                f"The controller practised for {policy.virtual_steps:,} steps in the model. They cost computing time "
                "alone. Without a model, each of them would have been a real step."
            )
        )
    if ledger.logged:
        said.append(paragraph(f"{steps(ledger.logged)} were recorded before, and cost nothing."))
    if ledger.unresolved:
        said.append(paragraph(f"Up to {steps(ledger.unresolved)} more may have been taken by samplers that failed."))
    return section("What it cost", "".join(said))


def purposes(known: Known) -> list[tuple[str, int]]:
    """Return the number of real steps by purpose; each step is counted once. Steps of logs are left out."""
    ledger = known.view.ledger
    return [
        ("learning the model: the first ones, spread over the declared ranges", ledger.initial),
        ("learning the model: chosen by the model, where it was unsure", ledger.adaptive),
        ("learning the model: sent without a query", ledger.manual),
        ("testing the prediction beforehand (audit)", ledger.audit),
        *tests(known),
    ]


def tests(known: Known) -> list[tuple[str, int]]:
    """Return the number of real steps in all evaluation episodes, by controller and starts."""
    own = [] if known.policy is None else known.policy.evaluations
    lines = [
        (f"{counted(one.episodes, 'episode')} with {ACTING[one.controller]}, {starts_of(one)}", one.steps)
        for one in own
    ]
    others = sum(one.steps for policy in known.others for one in policy.evaluations)
    lines.append((f"episodes with {counted(len(known.others), 'other version')} of the controller", others))
    unnamed = known.view.ledger.evaluation - sum(count for _, count in lines)
    return [*lines, ("other real episodes, of which no result is stored", max(unnamed, 0))]


def plan(view: SurrogateView) -> str:
    """Return sentences about the planned and the taken steps for learning the model."""
    taken, first, allowed = view.ledger.total, view.spec.design.budget, view.budget
    if not allowed:
        return "No real step was planned for learning the model: it was learned from recorded ones."
    said = f"For learning the model, at most {steps(allowed)} were allowed, and {taken:,} were taken."
    if first is not None and first < allowed:
        said = (
            f"For learning the model, {steps(first)} were planned at first. {allowed - first:,} more were allowed "
            "later, because a training or a person asked for steps where the controller goes. "
            f"{taken:,} were taken."
        )
    return f"{said} {_ended(view, taken, allowed)}".rstrip()


def _ended(view: SurrogateView, taken: int, allowed: int) -> str:
    """Return a sentence about why learning ended; empty if it has not."""
    if view.phase == "ready" and taken < allowed:
        return "The rest was not needed, because the model was known well enough."
    if view.phase == "over_budget":
        return "Then learning ended, although the model was not yet known well enough everywhere."
    if view.phase == "unsure":
        return "Learning ended before that, although the model was not yet known well enough everywhere."
    return ""
