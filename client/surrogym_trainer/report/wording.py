"""Words for numbers and specifications in a report."""

from __future__ import annotations

from collections.abc import Mapping

from surrogym_sampler.original.loading import is_known
from surrogym_shared.spec import EnvironmentSpec, Fixed, Inequality, Normal, Part, Success, Term, Uniform, limits
from surrogym_shared.wire import EvaluationView
from surrogym_shared.words import counted


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
    inner = _weighted(part.weights)
    if part.function != "linear":
        return _times(part.coefficient, f"{part.function}({inner})")
    return _times(part.coefficient, inner if len(part.weights) == 1 or part.coefficient == 1 else f"({inner})")


def _weighted(weights: Mapping[str, float]) -> str:
    return " + ".join(_times(weight, name) for name, weight in weights.items()).replace("+ -", "- ")


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
