"""Limits of a specification, evaluated at states: the distance to each limit, and the action of the fallback.

Shapes: n states, C coordinates, L limits, F action entries.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError

from surrogym_shared.checks import require, require_known, require_unique
from surrogym_shared.faults import first_fault
from surrogym_shared.spec import BoxAction, EnvironmentSpec, Term, limits
from surrogym_shared.spec.safety import Limit, Limits, NamedFallback
from surrogym_shared.terms import evaluate

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
CORNERS = 10  # with at most this many coordinates, limits are also checked at all corners of the ranges of start states
FEWEST_LEFT = 2  # a machine is stopped only if at least this number of its episodes left a declared limit
# A machine is stopped if too many of its episodes left a limit. If the true share is at most twice the allowed one, it
# is stopped by mistake with at most this probability.
LEFT_LEVEL = 0.01
# If a policy leaves the limits no more often than declared, they count as broken with at most this probability.
LEVEL = 0.05
STARTS = 1_000  # number of random start states at which limits are checked
# margin of a limit that is given at run time, as a share of the range of its term, for errors of the model
MARGIN = 0.01
LONGEST = 1_000  # largest number of characters of such a limit, which a file from anybody may have
LIMIT = re.compile(r"(?P<sum>.+?)\s*(?P<relation><=|>=)\s*(?P<value>\S+)")  # a limit that is given at run time


def limits_of(spec: EnvironmentSpec) -> Limits:
    """Return the limits of a specification, which must have some."""
    assert spec.limits is not None
    return spec.limits


def room(spec: EnvironmentSpec, coordinates: Array) -> Array:
    """Return the distances (n, L) of n states with coordinates (n, C) from the nearer end of each of L limits, in the
    limit's unit. A distance is negative beyond the end."""
    return distances(spec, limits_of(spec).keep, coordinates)


def distances(spec: EnvironmentSpec, keep: Sequence[Limit], coordinates: Array) -> Array:
    """Return what ``room`` does, for the limits ``keep``."""
    columns = []
    for limit in keep:
        value = evaluate(spec, limit.term, coordinates)
        below = np.inf if limit.low is None else value - limit.low
        above = np.inf if limit.high is None else limit.high - value
        columns.append(np.minimum(below, above))
    return np.stack(columns, axis=1)


def past(spec: EnvironmentSpec, coordinates: Array) -> Bools:
    """Return a mask (n,) of the states with coordinates (n, C) that lie beyond any limit."""
    return np.asarray((room(spec, coordinates) < 0).any(axis=1))


def falls_back(spec: EnvironmentSpec, before: Array, coordinates: Array) -> Bools:
    """Return a mask (n,) of the states in which the fallback acts.

    The fallback acts if the distance to a limit is below the limit's margin, now (at ``coordinates`` (n, C)) or after
    one more step with the same change as since the states one step earlier (``before`` (n, C)).
    """
    return is_near(margins(spec), room(spec, coordinates), room(spec, before))


def margins(spec: EnvironmentSpec) -> Array:
    """Return the margins (L,) of the L limits of a specification."""
    return np.array([limit.margin for limit in limits_of(spec).keep])


def is_near(margin: Array, now: Array, before: Array) -> Bools:
    """Return a mask (n,) of the states whose distance to any of L limits is below the limit's margin, now or after one
    more step in which the distance changes as much as in the last step.

    ``margin`` (L,) has the margins, ``now`` and ``before`` (n, L) the distances now and one step earlier.

    The sampler's guard and ``surrogym_trainer.deployment.reference`` call this function. Three files write the rule in
    another form, and must agree with it: ``surrogym_server.environment.safety`` for tensors,
    ``surrogym_trainer.deployment.c.source`` in C, and ``surrogym_trainer.deployment.st`` in structured text.
    """
    # A limit without ends has infinite distances: inf - inf gives NaN, which fmin ignores.
    with np.errstate(invalid="ignore"):
        return np.asarray((np.fmin(now, 2 * now - before) < margin).any(axis=-1))


def fallback_action(spec: EnvironmentSpec, coordinates: Array) -> Array:
    """Return the action (F,), with F entries, that the fallback takes in a state with coordinates (C,)."""
    terms = limits_of(spec).fallback
    # A named fallback is a program at the machine; it gives its actions itself.
    assert not isinstance(terms, NamedFallback)
    return clipped_action(spec, [float(evaluate(spec, term, coordinates[None])[0]) for term in terms])


def clipped_action(spec: EnvironmentSpec, action: ArrayLike) -> Array:
    """Return an action (F,), clipped to its range."""
    low, high = np.array(spec.action.ranges).T
    return np.asarray(np.clip(action, low, high), dtype=np.float64)


def nearest(spec: EnvironmentSpec, coordinates: Array) -> tuple[Limit, float]:
    """Return the limit that is nearest to a state with coordinates (C,), and the distance to the limit.

    To compare the limits, each distance is divided by the margin of its limit, if it has one.
    """
    every = room(spec, coordinates[None])[0]
    index = int(np.argmin([r / (limit.margin or 1.0) for r, limit in zip(every, limits_of(spec).keep, strict=True)]))
    return limits_of(spec).keep[index], float(every[index])


def words_of_fallbacks(expected: float, low: float, high: float) -> str:
    """Say in which share of the episodes of a policy the fallback is expected, with the interval of the share."""
    interval = f"{percent(low)} to {percent(high)} %"
    return f"the fallback is expected in {percent(expected)} % of the episodes ({interval}), so no more leave a limit"


def percent(share: float) -> str:
    """Return a share as percent with two digits; 100 for the whole."""
    return "100" if 100 * share >= 99.5 else f"{100 * share:.2g}"


def left_too_often(left: int, episodes: int, share: float, level: float) -> bool:
    """Return whether more of the ``episodes`` left a limit (``left`` of them) than the allowed ``share`` explains:
    an exact one-sided binomial test with the significance level ``level``."""
    if left == 0 or share >= 1:
        return False
    constant, odds = math.lgamma(episodes + 1) + episodes * math.log1p(-share), math.log(share) - math.log1p(-share)
    tail = (
        math.exp(constant + k * odds - math.lgamma(k + 1) - math.lgamma(episodes - k + 1))
        for k in range(left, episodes + 1)
    )
    return math.fsum(tail) < level


def must_stop(left: int, episodes: int, probability: float) -> bool:
    """Return whether a machine must take no further episodes: ``left`` of its ``episodes`` left a limit, at least two,
    and more than twice the allowed ``probability`` explains. The probability that a machine stops by mistake is 1 % at
    most."""
    return left >= FEWEST_LEFT and left_too_often(left, episodes, 2 * probability, LEFT_LEVEL)


class Step(Protocol):
    """A real step, of which only the coordinates (C,) before and after the step are read."""

    @property
    def coordinates(self) -> ArrayLike: ...

    @property
    def next_coordinates(self) -> ArrayLike: ...


@dataclass(frozen=True)
class KeptSteps:
    """How well a number of real steps kept the limits of a specification."""

    steps: int = 0
    beyond: tuple[int, ...] = ()  # for each limit, the number of steps that ended beyond it
    least: tuple[float, ...] = ()  # for each limit, the smallest distance to it after a step
    near: int = 0  # number of steps after which the fallback was due

    def with_steps(self, spec: EnvironmentSpec, steps: Iterable[Step]) -> KeptSteps:
        """Count further real steps."""
        pairs = [] if spec.limits is None else [(step.coordinates, step.next_coordinates) for step in steps]
        if not pairs:
            return self
        before, after = np.array(pairs, dtype=np.float64).transpose(1, 0, 2)
        rooms = room(spec, after)
        beyond, least = (rooms < 0).sum(0), rooms.min(0)
        if self.steps:
            beyond, least = beyond + self.beyond, np.minimum(least, self.least)
        near = self.near + int(falls_back(spec, before, after).sum())
        return KeptSteps(self.steps + len(after), tuple(beyond.tolist()), tuple(least.tolist()), near)

    def words(self, spec: EnvironmentSpec) -> list[str]:
        """Describe in sentences how well the steps kept each limit. Empty without steps."""
        if not self.steps:
            return []
        lines = [
            f"limit {limit.name}: {beyond} of {self.steps} real steps beyond it, least room "
            f"{least:.4g} {limit.unit}".rstrip()
            + f", margin {limit.margin:g}"
            for limit, beyond, least in zip(limits_of(spec).keep, self.beyond, self.least, strict=True)
        ]
        return [*lines, f"limits: the fallback was due after {self.near} of {self.steps} real steps"]


@dataclass(frozen=True)
class KeptEpisodes:
    """How N real episodes kept the limits of their specification.

    Attributes:
        episodes: number of episodes.
        violations: number of episodes that left a limit.
        fallbacks: number of steps in which the fallback acted in the place of the policy.
        fallback_episodes: number of episodes with such a step.
        steps: number of all steps.
        least_room: by name of the limit, the smallest distance from an end of it; negative if the limit was left.
        probability: declared share of episodes that may leave a limit.
    """

    episodes: int
    violations: int
    fallbacks: int
    fallback_episodes: int
    steps: int
    least_room: dict[str, float]
    probability: float

    def interval(self) -> tuple[float, float]:
        """Return the exact 95 % interval (Clopper and Pearson) of the share of episodes that leave a limit."""
        from scipy.stats import binomtest  # imported on first use, because SciPy takes a second to load

        found = binomtest(self.violations, self.episodes).proportion_ci(method="exact")
        return float(found.low), float(found.high)

    @property
    def broken(self) -> bool:
        """Whether more episodes left a limit than the declared probability explains, at a level of 5 %."""
        return left_too_often(self.violations, self.episodes, self.probability, LEVEL)

    def summary(self) -> dict[str, Any]:
        """Return the counts and the interval, as JSON."""
        return {**asdict(self), "interval": list(self.interval())}

    def words(self) -> str:
        """Describe in a sentence how the limits were kept."""
        low, high = self.interval()
        return (
            f"{self.violations} of {self.episodes} episodes left a limit (95 % interval {percent(low)} to "
            f"{percent(high)} %, allowed {100 * self.probability:g} %); the fallback acted in {self.fallbacks} of "
            f"{self.steps} steps, in {self.fallback_episodes} of {self.episodes} episodes"
        )

    def found(self, low: float, high: float) -> Literal["more often", "less often", "as often"]:
        """Return how often the fallback acted, beside the predicted interval of its share from ``low`` to ``high``: the
        share differs if its exact 95 % interval lies outside of the predicted one."""
        from scipy.stats import binomtest

        real = binomtest(self.fallback_episodes, self.episodes).proportion_ci(method="exact")
        return "more often" if real.low > high else "less often" if real.high < low else "as often"

    def expected(self, low: float, high: float) -> str:
        """Compare the share of episodes with a fallback with its predicted interval from ``low`` to ``high``, in
        words."""
        found = self.found(low, high)
        than = "as" if found == "as often" else "than"
        return f"the fallback acted {found} {than} expected: in {percent(low)} to {percent(high)} % of the episodes"


def check_limits(spec: EnvironmentSpec) -> None:
    """Check that the limits of a specification fit its other entries and each other.

    Raises:
        ValueError: a limit has an unknown coordinate, another unit than its coordinate, or a term that jumps where an
            angle is wrapped; limits contradict each other; an episode may start within a margin; the fallback is no
            action; or a period or a time limit is missing.
    """
    declared = limits_of(spec)
    require_unique("limit", (limit.name for limit in declared.keep))
    require(
        spec.sampling_period is not None,
        "limits: expected a sampling_period, because the fallback acts if no action arrives in one period, got none",
    )
    require(
        spec.time_limit is not None,
        "limits: expected a time_limit, got none: a virtual episode ends where the fallback would act, and gets the "
        "least reward for each further step up to the time_limit",
    )
    for limit in declared.keep:
        _check_term(spec, limit)
    _check_pairs(declared)
    _check_fallback(spec, declared)
    for states in starts(spec):
        inside = room(spec, states) - np.array([limit.margin for limit in declared.keep])
        row, column = np.unravel_index(int(np.argmin(inside)), inside.shape)
        limit = declared.keep[int(column)]
        require(
            inside[row, column] >= 0,
            f"limit {limit.name!r}: expected every start to be inside by at least the margin of {limit.margin:g}, got "
            "the start "
            f"{dict(zip(spec.coordinate_names, states[row].round(6).tolist(), strict=True))}",
        )


def _check_term(spec: EnvironmentSpec, limit: Limit) -> None:
    where, kinds = f"limit {limit.name!r}", {c.name: c for c in spec.coordinates}
    for part in limit.term.parts:
        require_known(f"{where}: term", part.weights, spec.coordinate_names)
        angles = [name for name in part.weights if kinds[name].kind == "angle"] if part.function == "linear" else []
        require(
            not angles,
            f"{where}: the angle {angles} jumps from pi to -pi: expected its sine or cosine, or a coordinate of kind "
            "'linear'",
        )
    parts = [
        part for part in limit.term.parts if part.function != "one" and part.coefficient and any(part.weights.values())
    ]
    require(bool(parts), f"{where}: expected a term of the state, got one that is constant")
    linear = {
        name: part.coefficient * weight
        for part in parts
        if part.function == "linear"
        for name, weight in part.weights.items()
    }
    # The unit is that of a single coordinate, or of those that a sum has unchanged, such as x in x + 0.3 v.
    alone = [name for name, weight in linear.items() if len(linear) == len(parts) == 1 or abs(weight) == 1]
    own = {kinds[name].unit for name in alone} - {""}
    require(
        not own or limit.unit in {"", *own},
        f"{where}: expected the coordinate's unit {' or '.join(map(repr, sorted(own)))}, got {limit.unit!r}",
    )


def limit_of(spec: EnvironmentSpec, text: str) -> Limit:
    """Return the limit of a text such as ``level<=11`` or ``x+0.3*v>=-1``: a sum of coordinates, a relation, a number.
    Its margin is ``MARGIN`` of the range of the sum.

    Raises:
        ValueError: the text is another one, a coordinate is unknown or an angle, the number lies outside of the range
            of the sum over the sampling ranges, or an episode may start beyond the limit or within its margin.
    """
    names, sides = spec.coordinate_names, LIMIT.fullmatch(text.strip()) if len(text) <= LONGEST else None
    angles = [c.name for c in spec.coordinates if c.kind == "angle"]
    weights, value = ({}, math.nan) if sides is None else (_weights(sides["sum"], names), _number(sides["value"]))
    require(
        any(weights.values()) and math.isfinite(value + sum(weights.values())),
        f"limit {text!r}: expected a sum of coordinates, <= or >=, and a number, such as {names[0]}<=1 or "
        f"0.3*{names[0]}+{names[-1]}>=-1, with the coordinates {', '.join(names)}",
    )
    require(
        weights.keys().isdisjoint(angles),
        f"limit {text!r}: expected coordinates that are no angles, because an angle jumps from pi to -pi, got "
        f"{', '.join(angles)}",
    )
    ranges = {c.name: limits(c.sampling) for c in spec.coordinates}
    low, high = np.sum([sorted(weight * end for end in ranges[name]) for name, weight in weights.items()], axis=0)
    margin, side = MARGIN * float(high - low), "high" if sides and sides["relation"] == "<=" else "low"
    try:
        limit = Limit.model_validate({"name": text[:64], "term": Term.linear(**weights), side: value, "margin": margin})
    except ValidationError as error:  # a number that is too large
        raise ValueError(f"limit {text!r}: {first_fault(error, got=True)}") from error
    _check_term(spec, limit)
    require(
        low + margin < value < high - margin,
        f"limit {text!r}: expected a number between {low:g} and {high:g}, where the model has samples, got {value:g}",
    )
    for states in starts(spec):
        inside = distances(spec, [limit], states)[:, 0]
        start = dict(zip(spec.coordinate_names, states[np.argmin(inside)].round(6).tolist(), strict=True))
        require(
            inside.min() >= margin,
            f"limit {text!r}: expected every start to be inside by at least {margin:g}, got the start {start}",
        )
    return limit


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _weights(text: str, names: Sequence[str]) -> dict[str, float]:
    """Return the weight of each coordinate in a sum such as ``x+0.3*v``; empty for another text."""
    one = "|".join(re.escape(name) for name in sorted(names, key=len, reverse=True))
    summand = rf"\s*([+-]?)\s*(?:([0-9.eE]+)\s*\*\s*)?({one})\s*"
    if not re.fullmatch(rf"{summand}(?:(?=[+-]){summand})*", text):
        return {}
    weights: dict[str, float] = {}
    for sign, factor, name in re.findall(summand, text):
        weights[name] = weights.get(name, 0.0) + _number(f"{sign}{factor or 1}")
    return weights


def _check_pairs(declared: Limits) -> None:
    """Check that limits of the same term leave a range between their margins. Raises ``ValueError``."""
    for one, other in product(declared.keep, repeat=2):
        if one.term == other.term and one.low is not None and other.high is not None:
            require(
                one.low + one.margin < other.high - other.margin,
                f"limits {one.name!r} and {other.name!r} contradict each other: expected room between {one.low:g} and "
                f"{other.high:g} less their margins, got none",
            )


def _check_fallback(spec: EnvironmentSpec, declared: Limits) -> None:
    if isinstance(declared.fallback, NamedFallback):
        return
    size = spec.action.size
    require(
        len(declared.fallback) == size,
        f"limits: expected a fallback of {size} terms, one for each entry of the action, got {len(declared.fallback)}",
    )
    for number, (term, (low, high)) in enumerate(zip(declared.fallback, spec.action.ranges, strict=True)):
        for part in term.parts:
            require_known(f"limits: entry {number} of the fallback", part.weights, spec.coordinate_names)
        constant = all(part.function == "one" for part in term.parts)
        # Value of the fallback's term at the state 0; if the term is constant, its value at every state.
        value = float(evaluate(spec, term, np.zeros((1, len(spec.coordinates))))[0])
        whole = isinstance(spec.action, BoxAction) or (constant and value.is_integer())
        got = f"{value:g}" if constant else "a term of the state"
        require(whole, f"limits: entry {number} of the fallback: expected the number of a discrete action, got {got}")
        require(
            not constant or low <= value <= high,
            f"limits: entry {number} of the fallback leaves the action's range: expected {low:g} to {high:g}, "
            f"got {value:g}",
        )


def starts(spec: EnvironmentSpec) -> Iterator[Array]:
    """Yield states (n, C) at which episodes may start: the listed states, or corners and random states of the start
    ranges."""
    if spec.starts:
        yield np.array(spec.starts)
        return
    ends = np.array([limits(spec.start[c.name]) for c in spec.coordinates])
    if len(ends) <= CORNERS:
        yield np.array(list(product(*ends)))
    yield np.random.default_rng(0).uniform(ends[:, 0], ends[:, 1], (STARTS, len(ends)))
