"""The first part of the report, for decisions: cost, result, prediction, doubts, and what to do next.

A section with missing data says what is missing, and shows the rest.
"""

from __future__ import annotations

from collections.abc import Sequence

from surrogym_client.report.doubts import next_steps, untested
from surrogym_client.report.episodes import Range, draw_episodes, draw_ranges
from surrogym_client.report.figures import svg
from surrogym_client.report.html import bullets, moving, on_screen, paragraph, picture, section, table
from surrogym_client.report.known import Known
from surrogym_client.report.maps import Cut
from surrogym_client.surrogates.advice import verdict
from surrogym_shared.intervals import of_mean
from surrogym_shared.wire import EpisodeTrace, EvaluationDetail, EvaluationView, Interval, OutputFidelity

RETURN = "The return of an episode is the sum of its rewards. Higher is better."
ACTIONS = {
    "zero": "with an action of zero all the time",
    "random": "with random actions",
    "reference": "with the reference controller",
}
SHORT_NAMES = {"zero": "left alone", "random": "random actions", "reference": "reference controller"}


def decision(known: Known, cuts: Sequence[Cut]) -> str:
    """All sections of this part, as HTML."""
    parts = [
        _in_short(known),
        _cost(known),
        _result(known),
        _beside(known),
        _prediction(known),
        _unsure(known, cuts),
        section("What was not tested", bullets(untested(known))),
        section("What to do next", bullets(next_steps(known))),
    ]
    if known.missing:
        parts.append(section("What could not be read", bullets(known.missing)))
    return "".join(parts)


def _in_short(known: Known) -> str:
    """The result in at most four sentences."""
    view, real = known.view, known.real
    if known.policy is None:
        said = f"There is a model of {view.name} from {steps(view.ledger.total)}, and no controller yet."
        return paragraph(
            said if known.models else f"There is neither a model nor a controller of {view.name} yet.", "short"
        )
    if real is None:
        said = "A controller was trained in the model. It has not been tested in the original environment."
        return paragraph(said, "short")
    sentences = [f"In {real.episodes} real episodes the controller earned {mean(real)} on average."]
    if real.success_rate is not None:
        sentences.append(f"{successes(real)} succeeded.")
    if known.without is not None:
        sentences.append(f"Without it, from the same starts, the average was {number(known.without.mean)}.")
    if known.reference is not None:
        sentences.append(f"The reference controller earned {mean(known.reference)} there.")
    sentences.append(f"Learning and checking it took {steps(view.ledger.total + view.ledger.audit)}.")
    return paragraph(" ".join(sentences), "short")


def _cost(known: Known) -> str:
    ledger, policy = known.view.ledger, known.policy
    lines = [
        ("learning the model", ledger.total),
        ("testing the prediction beforehand (audit)", ledger.audit),
        ("testing the controller, and what happens without it", ledger.evaluation),
        ("all together", ledger.total + ledger.audit + ledger.evaluation),
    ]
    said = [
        table(("real steps for", "steps"), [(name, f"{count:,}") for name, count in lines], "What was done in reality")
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


def _result(known: Known) -> str:
    real = known.real
    if real is None:
        why = "There is no controller yet." if known.policy is None else "It has not been tested in reality."
        return section("What it gives", paragraph(why))
    rows = [
        ("average return", mean(real)),
        ("episodes that succeeded", "no criterion was declared" if real.success_rate is None else successes(real)),
        ("best, median and worst return", " / ".join(number(one) for one in (real.most, real.median, real.least))),
        ("real episodes", f"{real.episodes} ({real.note or 'starts unknown'})"),
        ("real steps that this took", f"{real.steps:,}"),
    ]
    said = paragraph(RETURN) + table(("", ""), rows, "In the original environment; in brackets, 95 % intervals")
    shown = [(f"{t.rank}, return {number(sum(t.reward))}", t) for t in real.traces if t.rank != "paired"]
    order = {"best": 0, "median": 1, "worst": 2}
    shown.sort(key=lambda pair: order[pair[1].rank])
    if shown:
        alt = f"Coordinates and actions over the steps of {', '.join(name for name, _ in shown)}"
        said += picture(svg(draw_episodes(known.view.spec, shown)), alt)
        said += paragraph(
            "The best, the median and the worst of these episodes: half of all went at least as well as the median."
        )
    return section("What it gives", said + _video(known))


def _video(known: Known) -> str:
    """The video of the best, the median and the worst episode; nothing where there is none."""
    if known.video is None:
        return ""
    alt = "Video: the best, the median and the worst real episode beside each other"
    words = "The video shows the best, the median and the worst episode beside each other, drawn from their states."
    return on_screen(moving(*known.video, alt) + paragraph(words))


def _beside(known: Known) -> str:
    """Comparison of the controller with no controller, and with a reference controller."""
    real, title = known.real, "With and without the controller"
    if real is None:
        return section(title, paragraph("There is nothing to compare yet."))
    others = [one for one in (known.without, known.reference) if one is not None]
    said = "".join(paragraph(_gained(real, other)) for other in others)
    if known.without is None:
        said += paragraph("The same starts were not run without the controller.")
    return section(title, said + _from_one_start(known, real, others))


def _gained(real: EvaluationDetail, other: EvaluationDetail) -> str:
    """The gain in return over another controller from the same starts."""
    same = min(real.episodes, other.episodes)
    with_it = sum(real.returns[:same]) / same if real.returns else real.mean
    gain = with_it - (sum(other.returns[:same]) / same if other.returns else other.mean)
    return (
        f"From the same {same} starts, the average return was {number(with_it)} with the controller and "
        f"{mean(other)} {ACTIONS[other.controller]}: {number(abs(gain))} {'more' if gain > 0 else 'less'} with it"
        f"{_certain(real, other, same)}. The {steps(other.steps)} of the comparison are counted above."
    )


def _certain(real: EvaluationDetail, other: EvaluationDetail, same: int) -> str:
    """The 95 % interval of the difference, start by start; nothing where single episodes are not known."""
    if len(real.returns) < same or len(other.returns) < same:
        return ""
    found = of_mean([a - b for a, b in zip(real.returns[:same], other.returns[:same], strict=True)])
    if found is None:
        return ""
    low, high = sorted((abs(found.low), abs(found.high)))
    if found.low <= 0 <= found.high:
        return f" (95 %: {number(found.low)} to {number(found.high)}, so no difference was shown)"
    return f" (95 %: {number(low)} to {number(high)})"


def _from_one_start(known: Known, real: EvaluationDetail, others: Sequence[EvaluationDetail]) -> str:
    """Return a picture of one episode of each controller, all from the same start; empty if such episodes are
    unknown."""
    pairs = [(_paired(real), "with the controller"), *((_paired(one), SHORT_NAMES[one.controller]) for one in others)]
    shown = [(name, trace) for trace, name in pairs if trace is not None]
    if len(shown) < 2 or len({trace.seed for _, trace in shown}) > 1:
        return ""
    alt = f"Coordinates and actions of one episode each, from the same start: {', '.join(name for name, _ in shown)}"
    words = "They begin in the same state. It is the start from which the controller had its median return."
    return picture(svg(draw_episodes(known.view.spec, shown)), alt) + paragraph(words)


def _prediction(known: Known) -> str:
    """Comparison of imagined and real returns."""
    policy, real = known.policy, known.real
    promise = None if policy is None else policy.promise
    title = "Was it predicted?"
    if policy is None or promise is None:
        return section(title, paragraph("Nothing was predicted." if policy else "There is no controller yet."))
    ranges = [Range("predicted, 90 %", promise.median, promise.low, promise.high)]
    said = ["Nobody judged the prediction."]
    if policy.trusted is not None:
        said = [f"The prediction was {'trusted' if policy.trusted else 'not trusted'}: {policy.reason}."]
    if real is not None and real.declared:
        interval = real.mean_interval
        ranges.append(Range("real, 95 %", real.mean, *_ends(interval)))
        if real.mean < promise.low:
            said.append(f"Reality was worse than predicted, by {number(promise.low - real.mean)} beyond the interval.")
        elif real.mean > promise.high:
            said.append("Reality was better than predicted.")
        else:
            said.append("Reality came out as predicted: the real average lies within the predicted interval.")
    else:
        said.append("It has not been compared with reality from the same kind of starts.")
    for other in filter(None, (known.without, known.reference)):
        label = SHORT_NAMES[other.controller]
        ranges.append(Range(f"{label}, 95 %", other.mean, *_ends(other.mean_interval)))
    alt = "; ".join(f"{one.label}: {number(one.value)}" for one in ranges)
    return section(title, paragraph(" ".join(said)) + picture(svg(draw_ranges(ranges, "average return")), alt))


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
        said += paragraph("The maps under Details show where.")
    return section(title, said)


def _of_allowed(output: OutputFidelity) -> str:
    """The typical error as a share of the tolerance."""
    error = output.leave_one_out_error
    if error is None:
        return "-"
    ratio = error / output.tolerance
    return "less than 1 %" if ratio < 0.01 else f"{100 * ratio:.0f} %" if ratio < 10 else f"{ratio:.0f} times"


def _paired(evaluation: EvaluationDetail) -> EpisodeTrace | None:
    return next((trace for trace in evaluation.traces if trace.rank == "paired"), None)


def _ends(interval: Interval | None) -> tuple[float | None, float | None]:
    return (None, None) if interval is None else (interval.low, interval.high)


def number(value: float) -> str:
    """A return in readable form: large ones without decimals, small ones with three digits."""
    size = abs(value)
    return f"{value:,.0f}" if size >= 1_000 else f"{value:.1f}" if size >= 10 else f"{value:.3g}"


def mean(evaluation: EvaluationView) -> str:
    """A mean with its interval."""
    interval = evaluation.mean_interval
    return number(evaluation.mean) + (f" ({number(interval.low)} to {number(interval.high)})" if interval else "")


def successes(evaluation: EvaluationView) -> str:
    """Number of successful episodes, with the interval of the share."""
    assert evaluation.success_rate is not None
    count, interval = round(evaluation.success_rate * evaluation.episodes), evaluation.success_interval
    about = f" ({share(interval.low)} to {share(interval.high)})" if interval else ""
    return f"{count} of {evaluation.episodes}{about}"


def share(value: float) -> str:
    """A share as percent. It is never rounded up to 100."""
    if value >= 1:
        return "100 %"
    percent = 100 * value
    return f"{int(percent * 10) / 10:.1f} %" if percent >= 99 else f"{percent:.0f} %"


def steps(count: int) -> str:
    return f"{count:,} real step{'' if count == 1 else 's'}"
