"""The first part of the report, for decisions: cost, result, prediction, doubts, and recommended next steps.

A section with missing data names what is missing, and shows the rest. Each sentence about untested points and next
steps follows from stored data. The cost is that of real steps: each purpose has a line, and the lines add up to the
total. The result compares the controller with other controllers, from the same starts. Lines in figures of episodes
differ in stroke, so that they can be distinguished in black and white.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from surrogym_client.surrogates.advice import advice, verdict
from surrogym_sampler.original.loading import env_option, is_known, sample_command
from surrogym_shared import intervals
from surrogym_shared.limits import words_of_fallbacks
from surrogym_shared.spec import (
    Coordinate,
    EnvironmentSpec,
    Fixed,
    Inequality,
    Normal,
    Part,
    Success,
    Term,
    Uniform,
    limits,
)
from surrogym_shared.wire import (
    Controller,
    EpisodeTrace,
    EvaluationDetail,
    EvaluationView,
    Interval,
    OutputFidelity,
    PolicyPromise,
    PolicyView,
    SurrogateView,
)
from surrogym_shared.words import counted
from surrogym_trainer.coverage import Cut
from surrogym_trainer.figures import WIDTH, svg, with_unit
from surrogym_trainer.policies.card import limits_in, set_points_in, words_of_set_points
from surrogym_trainer.report.html import bullets, moving, on_screen, paragraph, picture, section, table
from surrogym_trainer.report.known import PREFERRED, Known

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
    points = words_of_set_points(set_points_in(known.policy.settings)) if known.policy is not None else ""
    limits = limits_in(known.policy.settings) if known.policy is not None else ()
    rows = [
        ("average return", mean(real)),
        *([("set points of the returns", points)] if points else []),
        *([("limits at run time", ", ".join(limits))] if limits else []),
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


SHORT_NAMES = {"zero": "no controller", "random": "random actions", "reference": "reference controller"}


@dataclass(frozen=True)
class Comparison:
    """The mean returns of two controllers from the same starts.

    Attributes:
        starts: number of these starts.
        mine, theirs: mean return of the policy and of the other controller.
        gain: 95 % interval of the difference; None if the returns of single episodes are not known.
    """

    starts: int
    mine: float
    theirs: float
    gain: intervals.Interval | None

    @property
    def shown(self) -> bool:
        """Whether the interval of the difference excludes 0."""
        return self.gain is not None and (self.gain.low > 0 or self.gain.high < 0)


def compare(real: EvaluationDetail, other: EvaluationDetail) -> Comparison | None:
    """Compare the mean returns of two controllers over the first starts, as many as both ran; None if their returns
    are not known."""
    count = min(real.episodes, other.episodes)
    if min(len(real.returns), len(other.returns)) >= count:
        mine, theirs = real.returns[:count], other.returns[:count]
        return Comparison(
            count, fmean(mine), fmean(theirs), intervals.of_mean([a - b for a, b in zip(mine, theirs, strict=True)])
        )
    return Comparison(count, real.mean, other.mean, None) if real.episodes == other.episodes else None


def in_short(real: EvaluationDetail, other: EvaluationDetail) -> str:
    """Return the comparison with another controller as a sentence."""
    found, name = compare(real, other), ACTING[other.controller]
    if found is None:
        return f"With {name}, {counted(other.episodes, 'episode')} earned {number(other.mean)} on average."
    starts = f"From {_starts(found.starts, real)}" if found.starts < real.episodes else "From the same starts"
    return f"{starts}, it earned {number(found.mine)} on average, and {name} earned {number(found.theirs)}."


def beside(known: Known) -> str:
    """Return the report's section that compares episodes with and without the controller, as HTML."""
    real, title = known.real, "With and without the controller"
    if real is None:
        return section(title, paragraph("There is nothing to compare yet."))
    others = [one for one in (known.without, known.reference) if one is not None]
    said = "".join(paragraph(_gained(real, other)) for other in others)
    if known.without is None:
        said += paragraph("The same starts were not run without the controller.")
    return section(title, said + _from_one_start(known, real, others))


def _gained(real: EvaluationDetail, other: EvaluationDetail) -> str:
    """Return sentences about the difference in return from another controller."""
    found, name = compare(real, other), ACTING[other.controller]
    if found is None:
        return (
            f"{counted(real.episodes, 'episode')} with the controller earned {number(real.mean)} on average, and "
            f"{counted(other.episodes, 'episode')} with {name} earned {number(other.mean)}. Their starts can't be "
            "compared one by one, because the single episodes are not known."
        )
    return (
        f"From {_starts(found.starts, real)}, the average return was {number(found.mine)} with the controller and "
        f"{number(found.theirs)} with {name}. {_difference(found)} The {other.steps:,} real steps with {name} are "
        "counted above."
    )


def _starts(count: int, real: EvaluationDetail) -> str:
    return f"the first {count} of these {real.episodes} starts" if count < real.episodes else f"the same {count} starts"


def _difference(found: Comparison) -> str:
    gain = found.mine - found.theirs
    if found.gain is None:
        return f"That is {number(abs(gain))} {'more' if gain > 0 else 'less'} with it."
    if not found.shown:
        return (
            f"No difference was shown: the controller's gain is {number(gain)} (95 %: {number(found.gain.low)} to "
            f"{number(found.gain.high)})."
        )
    low, high = sorted((abs(found.gain.low), abs(found.gain.high)))
    more = "more" if gain > 0 else "less"
    return f"That is {number(abs(gain))} {more} with it (95 %: {number(low)} to {number(high)})."


def _from_one_start(known: Known, real: EvaluationDetail, others: Sequence[EvaluationDetail]) -> str:
    """Return a picture of one episode of each controller from the same state, as HTML; empty if such episodes are not
    known."""
    pairs = [(_paired(real), "with the controller"), *((_paired(one), SHORT_NAMES[one.controller]) for one in others)]
    shown = [(name, trace) for trace, name in pairs if trace is not None]
    if len(shown) < 2 or len({trace.seed for _, trace in shown}) > 1:
        return ""
    alt = f"Coordinates and actions of one episode each, from the same start: {', '.join(name for name, _ in shown)}"
    words = "They begin in the same state. It is the start from which the controller had its median return."
    image = svg(draw_episodes(known.view.spec, shown, meet="start"))
    return picture(image, alt) + paragraph(f"{words} {turns(known.view.spec)}".rstrip())


def _paired(evaluation: EvaluationDetail) -> EpisodeTrace | None:
    return next((trace for trace in evaluation.traces if trace.rank == "paired"), None)


class Outcome(NamedTuple):
    """The result of comparing a prediction with reality.

    Attributes:
        verdict: ``better`` if the whole interval of the real average lies above the predicted interval, ``worse`` if it
            lies below, ``perhaps worse`` if only the real average itself lies below, and ``as predicted`` otherwise.
        beyond: distance of the real average from the predicted interval; 0 if it is inside.
    """

    verdict: Literal["as predicted", "better", "worse", "perhaps worse"]
    beyond: float


def outcome(promise: PolicyPromise, real: EvaluationView) -> Outcome:
    """Compare a prediction with real episodes from the declared starts. Differences that vanish by rounding don't
    count."""
    low, high = _ends(real.mean_interval)
    below, above = promise.low - real.mean, real.mean - promise.high
    if below > 0 and number(real.mean) != number(promise.low):
        return Outcome("worse" if (real.mean if high is None else high) < promise.low else "perhaps worse", below)
    if above > 0 and number(real.mean) != number(promise.high) and (real.mean if low is None else low) > promise.high:
        return Outcome("better", above)
    return Outcome("as predicted", max(below, above, 0.0))


def outcome_of(known: Known) -> Outcome | None:
    """Return how the real episodes of a report's policy compare with its promise: better, worse, or as predicted. None
    if the policy has no promise, or if no real episodes from the declared starts were reported."""
    promise = None if known.policy is None else known.policy.promise
    return outcome(promise, known.real) if promise and known.real and known.real.declared else None


def prediction(known: Known) -> str:
    """Return the report's section that compares the policy's promise with its evaluation, as HTML."""
    policy, real, title = known.policy, known.real, "Was it predicted?"
    promise = None if policy is None else policy.promise
    kept = [] if real is None or real.limits is None else [f"Limits in real episodes: {real.limits.said}."]
    if policy is None or promise is None:
        said = ["Nothing was predicted." if policy else "There is no controller yet.", *kept]
        return section(title, paragraph(" ".join(said)))
    ranges = [Range("predicted, 90 %", promise.median, promise.low, promise.high)]
    said = ["Nobody judged the prediction."]
    if policy.trusted is not None:
        said = [f"The prediction was {'trusted' if policy.trusted else 'not trusted'}: {policy.reason}."]
    if (share := promise.fallback) is not None:
        expected = share.median if share.mean is None else share.mean
        said.append(f"Limits: {words_of_fallbacks(expected, share.low, share.high)}.")
    found = outcome_of(known)
    if found is None or real is None:
        said.append("It has not been compared with reality from the same kind of starts.")
    else:
        ranges.append(_range("real", real))
        said.append(_words(found, promise, real))
    said += kept
    ranges += [_range(SHORT_NAMES[one.controller], one) for one in (known.without, known.reference) if one is not None]
    alt = "; ".join(f"{one.label}: {number(one.value)}" for one in ranges)
    picture_ = picture(svg(draw_ranges(ranges, "average return")), alt)
    return section(title, paragraph(" ".join(said)) + picture_ + paragraph(_caption(real)))


def _words(found: Outcome, promise: PolicyPromise, real: EvaluationView) -> str:
    predicted = f"{number(promise.low)} to {number(promise.high)}"
    match found.verdict:
        case "worse":
            return f"Reality was worse than predicted, by {number(found.beyond)} beyond the interval of {predicted}."
        case "better":
            return f"Reality was better than predicted, by {number(found.beyond)} beyond the interval of {predicted}."
        case "perhaps worse":
            return (
                f"The real average lies {number(found.beyond)} below the predicted interval of {predicted}. This may "
                f"be chance: the interval of {counted(real.episodes, 'real episode')} overlaps with the predicted one."
            )
        case _ if found.beyond > 0:
            return "Reality came out as predicted: the intervals of the real and of the predicted average overlap."
        case _:
            return "Reality came out as predicted: the real average lies within the predicted interval."


def _caption(real: EvaluationView | None) -> str:
    words = "A dot is an average, and a line is its interval. Farther right is better."
    return words if real is None else f"{words} Rows with fewer episodes have the first of the same starts."


def _range(label: str, one: EvaluationView) -> Range:
    return Range(f"{label}, {counted(one.episodes, 'episode')}, 95 %", one.mean, *_ends(one.mean_interval))


def _ends(interval: Interval | None) -> tuple[float | None, float | None]:
    return (None, None) if interval is None else (interval.low, interval.high)


Array = NDArray[np.float64]
Meet = Literal["start", "end"]
TURN = 2 * np.pi


class Stroke(NamedTuple):
    """The look of a line: colour, style and width."""

    colour: str
    style: str
    width: float


STROKES = (Stroke("black", "-", 1.6), Stroke("#2457c5", "--", 1.4), Stroke("#b3261e", ":", 2.0))


class Range(NamedTuple):
    """A mean return of one kind of episodes, with its interval."""

    label: str
    value: float
    low: float | None
    high: float | None


def draw_episodes(spec: EnvironmentSpec, shown: Sequence[tuple[str, EpisodeTrace]], meet: Meet = "end") -> Figure:
    """Draw coordinates and actions over the steps, one line for each of at most three episodes.

    Angles are drawn without jumps. At the step ``meet`` (the first or the last), the lines of an angle are shifted by
    full turns to be as near to each other as possible.
    """
    actions = len(shown[0][1].action[0]) if shown[0][1].action else 0
    labels = [
        *map(with_unit, spec.coordinates),
        *(f"action {i + 1}" if actions > 1 else "action" for i in range(actions)),
    ]
    figure = Figure(figsize=(1.5 * WIDTH, 1.5 * len(labels) + 0.6), layout="constrained")
    grid = figure.subplots(len(labels), 1, sharex=True, squeeze=False)[:, 0]
    first = shown[0][1].coordinates[_place(meet)]
    for (name, trace), stroke in zip(shown, STROKES, strict=False):
        states, given = np.array(trace.coordinates), np.array(trace.action).reshape(len(trace.action), -1)
        lines = [unbroken(c, states[:, i], meet, first[i]) for i, c in enumerate(spec.coordinates)]
        lines += [given[:, i] for i in range(actions)]
        for axes, line in zip(grid, lines, strict=True):
            axes.plot(line, color=stroke.colour, linestyle=stroke.style, linewidth=stroke.width, label=name)
    for axes, label in zip(grid, labels, strict=True):
        axes.set(ylabel=label)
        axes.grid(alpha=0.3)
    grid[-1].set(xlabel="step")
    figure.align_ylabels()
    handles, names = grid[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper left", ncols=3, frameon=False)
    return figure


def turns(spec: EnvironmentSpec) -> str:
    """Return a sentence about how angles are drawn; empty if there is no angle."""
    if all(coordinate.kind != "angle" for coordinate in spec.coordinates):
        return ""
    return "Angles are drawn without a jump after a full turn: values that are 6.28 rad apart are the same position."


def draw_ranges(ranges: Sequence[Range], label: str) -> Figure:
    """Draw numbers with their intervals one below the other, on one axis."""
    figure = Figure(figsize=(1.5 * WIDTH, 0.55 * len(ranges) + 0.9), layout="constrained")
    axes = figure.add_subplot()
    places = list(range(len(ranges)))[::-1]
    for place, one in zip(places, ranges, strict=True):
        if one.low is not None and one.high is not None:
            axes.plot([one.low, one.high], [place, place], color="black", linewidth=2, marker="|", markersize=12)
        axes.plot([one.value], [place], color="black", marker="o", markersize=8, linestyle="none")
        axes.annotate(f"{one.value:.4g}", (one.value, place), (0, 9), textcoords="offset points", ha="center")
    axes.set(yticks=places, yticklabels=[one.label for one in ranges], ylim=(-0.6, len(ranges) - 0.3), xlabel=label)
    axes.margins(x=0.12)
    axes.grid(axis="x", alpha=0.3)
    return figure


def unbroken(coordinate: Coordinate, values: Array, meet: Meet, to: float) -> Array:
    """Return the values (n,) of a coordinate for a picture. An angle is continued without jumps from pi to -pi, and
    shifted by full turns so that it is as near to ``to`` as possible at the step ``meet``."""
    if coordinate.kind != "angle":
        return values
    turned = np.unwrap(values)
    away = np.round((turned[_place(meet)] - to) / TURN)
    shown: Array = turned - TURN * away
    return shown


def _place(meet: Meet) -> int:
    """Return the index of the step at which drawn lines of an angle are to coincide: the first or the last."""
    return 0 if meet == "start" else -1


def number(value: float) -> str:
    """Return a return in readable form: large numbers without decimals, small ones with three digits."""
    size = abs(value)
    return f"{value:,.0f}" if size >= 1_000 else f"{value:.1f}" if size >= 10 else f"{value:.3g}"


def mean(evaluation: EvaluationView) -> str:
    """Return the mean return of an evaluation with its interval, as text."""
    interval = evaluation.mean_interval
    return number(evaluation.mean) + (f" ({number(interval.low)} to {number(interval.high)})" if interval else "")


def successes(evaluation: EvaluationView) -> str:
    """Return the number of successful episodes with the interval of their share, as text."""
    if evaluation.success_rate is None:
        return "-"
    count, interval = round(evaluation.success_rate * evaluation.episodes), evaluation.success_interval
    about = f" ({share(interval.low)} to {share(interval.high)})" if interval else ""
    return f"{count} of {evaluation.episodes}{about}"


def share(value: float) -> str:
    """Return a share as a percentage in words. A share below 1 is never shown as 100 %."""
    if value >= 1:
        return "100 %"
    percent = 100 * value
    return f"{int(percent * 10) / 10:.1f} %" if percent >= 99 else f"{percent:.0f} %"


def steps(count: int) -> str:
    return counted(count, "real step")


def starts_of(evaluation: EvaluationView) -> str:
    """Return the starts and the machine of some episodes in words, without the first seed. The environment is named
    unless it is the surrogate's own."""
    said = evaluation.note.replace(f", from seed {evaluation.first_seed}", "") or "starts unknown"
    return said if evaluation.own else f"in {evaluation.environment}: {said}"


def original(environment: str) -> str:
    """Return a sentence about what "real" means for this environment."""
    if not environment:
        what = "which has no name here. Only its owner knows whether it is the machine itself or a simulator of it"
    elif is_known(environment):
        what = f"which is the simulator {environment} here. No machine was used"
    else:
        what = (
            f"which is {environment} here, a program of its owner. Only the owner knows whether it drives the machine "
            "itself or a simulator of it"
        )
    return f"\u201cReal\u201d means: in the original environment, {what}."


def criterion(success: Success) -> str:
    """Return a sentence about when an episode succeeds, from the specification."""
    last = "at its end" if success.hold_steps == 1 else f"in each of its last {success.hold_steps} steps"
    conditions = [
        *([f"{' and '.join(map(_inequality, success.hold))} {last}"] if success.hold else []),
        *([] if success.min_steps is None else [f"it lasts for at least {counted(success.min_steps, 'step')}"]),
        *([] if success.terminated is None else [_ending(success.terminated)]),
        *([] if success.min_return is None else [f"its return is at least {number(success.min_return)}"]),
    ]
    return f"An episode succeeds if {', and '.join(conditions)}."


def _ending(terminated: bool) -> str:
    rule = "a rule of the specification ends it"
    return f"{rule} before its time is over" if terminated else f"no {rule.removeprefix('a ')}"


def _inequality(one: Inequality) -> str:
    return f"{term(one.term)} {one.relation} {one.value:g}"


def term(one: Term) -> str:
    """Return a sum of functions of coordinates in words, such as "cos(theta) + 2 speed"."""
    words = " + ".join(map(_part, one.parts)).replace("+ -", "- ")
    ends = [f"at {what} {value:g}" for what, value in (("least", one.low), ("most", one.high)) if value is not None]
    return f"({words}, {' and '.join(ends)})" if ends else words


def _part(part: Part) -> str:
    if part.function == "one":
        return f"{part.coefficient:g}"
    inner = " + ".join(_times(weight, name) for name, weight in part.weights.items()).replace("+ -", "- ")
    if part.function != "linear":
        return _times(part.coefficient, f"{part.function}({inner})")
    return _times(part.coefficient, inner if len(part.weights) == 1 or part.coefficient == 1 else f"({inner})")


def _times(factor: float, words: str) -> str:
    return words if factor == 1 else f"-{words}" if factor == -1 else f"{factor:g} {words}"


def starts(spec: EnvironmentSpec) -> str:
    """Return the declared starts in words, such as "theta 3.14 rad, speed -1 to 1 rad/s"."""
    if spec.starts:
        return f"one of {counted(len(spec.starts), 'state')}"
    return ", ".join(f"{one.name} {_spread(spec.start[one.name])} {one.unit}".rstrip() for one in spec.coordinates)


def _spread(distribution: Uniform | Normal | Fixed) -> str:
    low, high = limits(distribution)
    return f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
