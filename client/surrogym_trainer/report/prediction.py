"""The section of the report that compares the predicted return with the real one."""

from __future__ import annotations

from typing import Literal, NamedTuple

from surrogym_shared.wire import EvaluationView, Interval, PolicyPromise
from surrogym_shared.words import counted
from surrogym_trainer.report.comparisons import SHORT_NAMES
from surrogym_trainer.report.episodes import Range, draw_ranges
from surrogym_trainer.report.figures import svg
from surrogym_trainer.report.html import paragraph, picture, section
from surrogym_trainer.report.known import Known
from surrogym_trainer.report.wording import number


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
    """Return the outcome for the policy of a report; None if there is no promise, or no episodes to which
    it applies."""
    promise = None if known.policy is None else known.policy.promise
    return outcome(promise, known.real) if promise and known.real and known.real.declared else None


def prediction(known: Known) -> str:
    """Return the report's section that compares the policy's promise with its evaluation, as HTML."""
    policy, real, title = known.policy, known.real, "Was it predicted?"
    promise = None if policy is None else policy.promise
    if policy is None or promise is None:
        return section(title, paragraph("Nothing was predicted." if policy else "There is no controller yet."))
    ranges = [Range("predicted, 90 %", promise.median, promise.low, promise.high)]
    said = ["Nobody judged the prediction."]
    if policy.trusted is not None:
        said = [f"The prediction was {'trusted' if policy.trusted else 'not trusted'}: {policy.reason}."]
    found = outcome_of(known)
    if found is None or real is None:
        said.append("It has not been compared with reality from the same kind of starts.")
    else:
        ranges.append(_range("real", real))
        said.append(_words(found, promise, real))
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
