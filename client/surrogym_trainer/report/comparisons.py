"""The section of the report that compares the controller with other controllers, from the same starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from surrogym_shared.intervals import Interval, of_mean
from surrogym_shared.wire import EpisodeTrace, EvaluationDetail
from surrogym_shared.words import counted
from surrogym_trainer.report.cost import ACTING
from surrogym_trainer.report.episodes import draw_episodes, turns
from surrogym_trainer.report.figures import svg
from surrogym_trainer.report.html import paragraph, picture, section
from surrogym_trainer.report.known import Known
from surrogym_trainer.report.wording import number

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
    gain: Interval | None

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
            count, fmean(mine), fmean(theirs), of_mean([a - b for a, b in zip(mine, theirs, strict=True)])
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
