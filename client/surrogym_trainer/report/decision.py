"""The first part of the report, for decisions: cost, result, prediction, doubts, and recommended next steps.

A section with missing data names what is missing, and shows the rest. Each sentence about untested points and next
steps follows from stored data.
"""

from __future__ import annotations

from collections.abc import Sequence

from surrogym_client.surrogates.advice import advice, verdict
from surrogym_sampler.original.loading import env_option, is_known, sample_command
from surrogym_shared.wire import EvaluationDetail, EvaluationView, OutputFidelity, PolicyView
from surrogym_shared.words import counted
from surrogym_trainer.report.comparisons import beside, in_short
from surrogym_trainer.report.cost import cost, tests
from surrogym_trainer.report.coverage import Cut
from surrogym_trainer.report.episodes import draw_episodes, turns
from surrogym_trainer.report.figures import svg
from surrogym_trainer.report.html import bullets, moving, on_screen, paragraph, picture, section, table
from surrogym_trainer.report.known import PREFERRED, Known
from surrogym_trainer.report.prediction import outcome_of, prediction
from surrogym_trainer.report.wording import (
    criterion,
    mean,
    number,
    original,
    share,
    starts,
    starts_of,
    steps,
    successes,
)

NO_CRITERION = "Nobody declared what a success is, so this report can't tell how many episodes failed."
RETURN = "The return of an episode is the sum of its rewards. Higher is better."


def decision(known: Known, cuts: Sequence[Cut]) -> str:
    """Return all sections of the report's first part, for decisions, as HTML.

    ``cuts`` are the maps of the model's uncertainty.
    """
    parts = [
        _in_short(known),
        cost(known),
        _result(known),
        beside(known),
        prediction(known),
        _unsure(known, cuts),
        section("What was not tested", paragraph(tested(known)) + bullets(untested(known))),
        section("What to do next", bullets(next_steps(known))),
    ]
    if known.missing:
        parts.append(section("What could not be read", bullets(known.missing)))
    return "".join(parts)


def _in_short(known: Known) -> str:
    """Return the result in at most four sentences, as HTML."""
    view, real = known.view, known.real
    if known.policy is None:
        said = f"There is a model of {view.name} from {steps(view.ledger.total)}, and no controller yet."
        return paragraph(
            said if known.models else f"There is neither a model nor a controller of {view.name} yet.", "short"
        )
    if real is None:
        said = "A controller was trained in the model. It has not been tested in the original environment."
        return paragraph(said, "short")
    sentences = [f"In {counted(real.episodes, 'real episode')} the controller earned {mean(real)} on average."]
    if real.success_rate is not None:
        sentences.append(f"{successes(real)} succeeded.")
    sentences += [in_short(real, other) for other in (known.without, known.reference) if other is not None]
    before, testing = view.ledger.total + view.ledger.audit, sum(count for _, count in tests(known))
    sentences.append(f"Learning and checking it took {steps(before)}, and testing took {testing:,} more.")
    return paragraph(" ".join(sentences), "short") + paragraph(" ".join(_meanings(known)))


def _meanings(known: Known) -> list[str]:
    """Return a sentence about each word of the summary that a reader may not know."""
    success = known.view.spec.success
    said = [original(known.view.environment), RETURN]
    said.append(NO_CRITERION if success is None else criterion(success))
    said.append("In brackets: the interval that contains the true value with 95 % certainty.")
    return said


def _result(known: Known) -> str:
    real = known.real
    if real is None:
        why = "There is no controller yet." if known.policy is None else "It has not been tested in reality."
        return section("What it gives", paragraph(why) + _further(known))
    rows = [
        ("average return", mean(real)),
        ("episodes that succeeded", "no criterion was declared" if real.success_rate is None else successes(real)),
        ("best, median and worst return", " / ".join(number(one) for one in (real.most, real.median, real.least))),
        ("real episodes", f"{real.episodes} ({starts_of(real)})"),
        *([("an episode begins at", starts(known.view.spec))] if real.declared else []),
        ("real steps that this took", f"{real.steps:,}"),
    ]
    said = table(("", ""), rows, "In the original environment; in brackets, 95 % intervals")
    return section("What it gives", said + _best_to_worst(known, real) + _video(known) + _further(known))


def _best_to_worst(known: Known, real: EvaluationDetail) -> str:
    """Return the picture of the best, median and worst episode, as HTML; empty if their traces are not known."""
    returns = {"best": real.most, "median": real.median, "worst": real.least}
    traces = {trace.rank: trace for trace in real.traces}
    shown = [(f"{rank}, return {number(value)}", traces[rank]) for rank, value in returns.items() if rank in traces]
    if not shown:
        return ""
    spec = known.view.spec
    alt = f"Coordinates and actions over the steps of {', '.join(name for name, _ in shown)}"
    words = "The best, the median and the worst of these episodes: half of all went at least as well as the median."
    return picture(svg(draw_episodes(spec, shown)), alt) + paragraph(f"{words} {turns(spec)}".rstrip())


def _further(known: Known) -> str:
    """Return a table of the policy's real episodes that no other section shows, such as those in other environments, as
    HTML; empty if there are none."""
    evaluations = [] if known.policy is None else known.policy.evaluations
    shown = None if known.real is None else known.real.id
    others = [one for one in evaluations if one.controller == "policy" and one.id != shown]
    if not others:
        return ""
    rows = [(starts_of(one), one.episodes, mean(one), successes(one)) for one in others]
    return table(("starts", "real episodes", "average return", "succeeded"), rows, "Further tests of this controller")


def _video(known: Known) -> str:
    """Return the video of the best, median and worst episode, as HTML; empty if there is none."""
    if known.video is None:
        return ""
    alt = "Video: the best, the median and the worst real episode beside each other"
    words = "The video shows the best, the median and the worst episode beside each other, drawn from their states."
    return on_screen(moving(*known.video, alt) + paragraph(words))


def _unsure(known: Known, cuts: Sequence[Cut]) -> str:
    view = known.view
    title = "Where the model is unsure"
    if view.fidelity is None:
        return section(title, paragraph("There is no model yet, so nothing is known."))
    units = {coordinate.name: coordinate.unit for coordinate in view.spec.coordinates}
    rows = [
        (one.name, units.get(one.name) or "-", share(one.coverage), one.tolerance, _of_allowed(one))
        for one in view.fidelity.outputs
    ]
    heading = ("what is predicted", "unit", "known well enough in", "error allowed", "typical error, of that")
    said = table(heading, rows, "Over the whole range of states and actions that was declared")
    sentence = verdict(view)
    said += paragraph(f"The model is {sentence}." if sentence else "")
    if cuts:
        said += paragraph(_on_maps(cuts))
    return section(title, said)


def _of_allowed(output: OutputFidelity) -> str:
    """Return the typical error of an output as a share of its tolerance, in words."""
    error = output.leave_one_out_error
    if error is None:
        return "-"
    ratio = error / output.tolerance
    return "less than 1 %" if ratio < 0.01 else f"{100 * ratio:.0f} %" if ratio < 10 else f"{ratio:.0f} times"


def _on_maps(cuts: Sequence[Cut]) -> str:
    """Return a sentence about the share of the maps on which the model is unsure."""
    parts = [float((cut.uncertainty > 1).mean()) for cut in cuts]
    where = "with the other coordinates and the action in the middle of their ranges"
    if not any(parts):
        return f"The maps under Details show no region where the model is unsure ({where})."
    return f"The maps under Details show where: in up to {share(max(parts))} of a map ({where})."


FEW = 30  # the report says that an average over fewer episodes than this is unreliable


def tested(known: Known) -> str:
    """Return a sentence about the starts and machines with which the controller was tested; empty without real
    episodes."""
    evaluations = [] if known.policy is None else known.policy.evaluations
    most: dict[str, int] = {}
    for one in evaluations:
        if one.controller == "policy":
            most[starts_of(one)] = max(most.get(starts_of(one), 0), one.episodes)
    own = [f"{starts} ({counted(episodes, 'episode')})" for starts, episodes in most.items()]
    return f"Tested were: {'; '.join(own)}. Not tested were:" if own else ""


def untested(known: Known) -> list[str]:
    """Return sentences about what the real episodes do not cover."""
    policy, real = known.policy, known.real
    if policy is None:
        return ["Everything: there is no controller yet."]
    if real is None:
        return ["The controller itself: no real episode was run with it in its own environment."]
    found = []
    if real.episodes < FEW:
        said = f"{counted(real.episodes, 'episode')} say{'s' if real.episodes == 1 else ''} little of an average"
        found.append(f"Many starts: {said}; {FEW} or more would.")
    if not _other_starts(policy):
        found.append("Starts outside the declared ones.")
    if not _other_machines(policy):
        found.append("Another unit of the machine, or a worn one: its physical parameters were as they are.")
    limit = known.view.spec.time_limit
    if limit is not None:
        found.append(f"Episodes longer than {limit} steps.")
    if policy.audit is None:
        found.append("The model's prediction, by an audit before the test.")
    if not any(one.controller == "reference" for one in policy.evaluations):
        found.append("A controller of reference, such as the one in use today.")
    found.append("Disturbances, faults of sensors, and everything outside the declared ranges of the coordinates.")
    return found


def next_steps(known: Known) -> list[str]:
    """Return recommended next steps, the most urgent first."""
    view, policy, real = known.view, known.policy, known.real
    name = view.name
    if policy is None:
        start = sample_command(name, view.environment)
        return [
            f"Train a controller: surrogym train {name}"
            if known.models
            else f"Let a sampler answer the first queries: {start}"
        ]
    run = f"surrogym evaluate policy.zip{_where(known)}"
    fetch = f"Fetch its file for the next commands: surrogym policy get {name}@{policy.version} --out policy.zip"
    if policy.drifted_at is not None:
        return ["Don't use it: the machine has changed. Register it under another name, and begin again."]
    if real is None:
        return [fetch, f"Test it in reality: {run} --compare zero", *_of_the_model(known)]
    found = []
    judged = outcome_of(known)
    if policy.trusted is False or (judged is not None and judged.verdict == "worse"):
        found.append("Don't use it yet: the model was wrong, or not sure, where this controller goes.")
        found.append(f"Ask for real steps on its way, and train again: surrogym train {name} --improve 8")
    elif real.success_rate is not None and real.success_rate < 1:
        found.append("Look at the worst episode above before it is used: not every start succeeded.")
    elif real.success_rate is None:
        found.append("Look at the worst episode above, and decide whether it is good enough: no success was declared.")
    tests = _tests(known, policy, real, run)
    found += [fetch, *tests] if tests else []
    if real.promise_kept and policy.trusted is not False and PREFERRED not in policy.aliases:
        found.append(f"If that is good enough, name it: surrogym policy alias {name}@{policy.version} {PREFERRED}")
    return found + _of_the_model(known)


def _where(known: Known) -> str:
    """Return the option ``--env`` for a suggested command; empty if the command finds the environment without it."""
    return env_option(known.view.environment)


def _tests(known: Known, policy: PolicyView, real: EvaluationView, run: str) -> list[str]:
    """Return the tests in reality that are still missing, with their commands; ``run`` is the command of an
    evaluation."""
    found = []
    if real.episodes < FEW:
        found.append(f"Run more episodes: {run} --episodes {FEW}")
    if known.without is None:
        found.append(f"Run the same starts without it: {run} --compare random")
    if not any(one.controller == "reference" for one in policy.evaluations):
        found.append(f"Compare it with the controller in use today: {run} --reference module:Class")
    if not _other_starts(policy):
        found.append(f"See how it does from other starts: {run} --wide")
    if not _other_machines(policy):
        changed = f": {run} --perturb 0.1" if is_known(known.view.environment) else ", in a machine that you changed"
        found.append(f"Find out how much change of the machine it stands{changed}")
    return found


def _other_starts(policy: PolicyView) -> bool:
    """Return whether the policy was tested from starts outside the declared ones."""
    own = [one.note for one in policy.evaluations if one.controller == "policy"]
    return any("anywhere" in note or "times as far" in note for note in own)


def _other_machines(policy: PolicyView) -> bool:
    """Return whether the policy was tested in an environment other than its own, or in a changed one."""
    own = [one for one in policy.evaluations if one.controller == "policy"]
    return any(not one.own or "changed by" in one.note for one in own)


def _of_the_model(known: Known) -> list[str]:
    said = advice(known.view, known.models)
    return [f"To make the model surer: {said}"] if said else []
