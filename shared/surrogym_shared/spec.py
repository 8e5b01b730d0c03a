"""EnvironmentSpec: what is known of an original environment before the first query.

Symbols: coordinates ``q`` (n, C), observation ``o`` (n, D), action ``u`` (n, F). A specification is data: adapters make
it for known environments, people write it as JSON or Python for their own, and no part of it is ever evaluated as code.
Every contradiction is refused here, with what was expected and what came.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, model_validator

from surrogym_shared.checks import (
    Count,
    Finite,
    Number,
    Positive,
    Width,
    require,
    require_known,
    require_range,
    require_unique,
)

MAX_DIMENSIONS = 64
MAX_TERM_PARTS = 64
MAX_DISCRETE_ACTIONS = 4096
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
MAX_INEQUALITIES = 16  # in a group, and groups
MAX_ROLLOUT_QUERY = 4_096  # real steps that one query may ask for
REWARD = "reward"

Name = Annotated[str, Field(min_length=1, max_length=64)]


class Frozen(BaseModel):
    """Base of every model here: immutable, and unknown fields are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="null")


# Distributions


class Uniform(Frozen):
    """Uniform on [low, high]."""

    kind: Literal["uniform"] = "uniform"
    low: Number
    high: Number

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        require_range("uniform range", self.low, self.high)
        return self


class Normal(Frozen):
    """Normal, truncated to [low, high]; without limits it is truncated at three standard deviations."""

    kind: Literal["normal"] = "normal"
    mean: Number
    std: Width
    low: Number | None = None
    high: Number | None = None

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        low, high = self.limits
        require_range("truncated range", low, high)
        z = max(low - self.mean, self.mean - high) / self.std
        require(z < 6, f"truncation [{low}, {high}] lies {z:.1f} standard deviations from the mean {self.mean}")
        return self

    @property
    def limits(self) -> tuple[float, float]:
        low = self.mean - 3 * self.std if self.low is None else self.low
        high = self.mean + 3 * self.std if self.high is None else self.high
        return low, high


class Fixed(Frozen):
    """One value; only for the start distribution."""

    kind: Literal["fixed"] = "fixed"
    value: Number


SamplingDistribution = Annotated[Uniform | Normal, Field(discriminator="kind")]
StartDistribution = Annotated[Uniform | Normal | Fixed, Field(discriminator="kind")]


def limits(distribution: Uniform | Normal | Fixed) -> tuple[float, float]:
    """Smallest and largest value a distribution can give."""
    match distribution:
        case Uniform():
            return distribution.low, distribution.high
        case Normal():
            return distribution.limits
        case Fixed():
            return distribution.value, distribution.value


# Coordinates


class Bounds(Frozen):
    """Saturation: the environment clips the coordinate to [low, high].

    ``stops`` names a coordinate that is set to zero when this one runs into the bound (a wall; MountainCar's left end).
    """

    low: Number | None = None
    high: Number | None = None
    stops: Name | None = None

    @model_validator(mode="after")
    def _some(self) -> Self:
        require(self.low is not None or self.high is not None, "bounds need a low or a high")
        if self.low is not None and self.high is not None:
            require_range("range of bounds", self.low, self.high)
        return self


class Coordinate(Frozen):
    """One entry of q: part of the state that the original environment is set to.

    ``linear`` and ``angle`` (wrapped to [-pi, pi)) move with the dynamics; ``constant`` is drawn at the start of an
    episode and stays (Reacher's target). ``sampling`` is the distribution of design queries.
    """

    name: Name
    kind: Literal["linear", "angle", "constant"] = "linear"
    sampling: SamplingDistribution
    bounds: Bounds | None = None
    unit: str = ""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.kind != "linear":
            require(self.bounds is None, f"coordinate {self.name!r}: only a linear coordinate can have bounds")
        if self.bounds is not None:
            low, high = limits(self.sampling)
            inside = (self.bounds.low is None or self.bounds.low <= low) and (
                self.bounds.high is None or high <= self.bounds.high
            )
            require(
                inside,
                f"coordinate {self.name!r}: sampling range [{low}, {high}] leaves its bounds "
                f"[{self.bounds.low}, {self.bounds.high}]",
            )
        return self


# Terms


class Part(Frozen):
    """coefficient * phi(q), phi one of: ``one`` = 1, ``linear`` = a.q, ``sin`` = sin(a.q), ``cos`` = cos(a.q)."""

    function: Literal["one", "linear", "sin", "cos"]
    coefficient: Number = 1.0
    weights: dict[Name, Number] = Field(default_factory=dict, description="a, by coordinate name")

    @model_validator(mode="after")
    def _weighted(self) -> Self:
        if self.function == "one":
            require(not self.weights, "a part with function 'one' takes no weights")
        else:
            require(bool(self.weights), f"a part with function {self.function!r} needs weights")
        return self


class Term(Frozen):
    """A sum of parts, optionally clipped to [low, high]. Terms add with ``+`` and scale with ``*``."""

    parts: tuple[Part, ...] = Field(min_length=1, max_length=MAX_TERM_PARTS)
    low: Number | None = None
    high: Number | None = None

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.low is not None and self.high is not None:
            require(self.low < self.high, f"term clip crosses: expected low < high, got [{self.low}, {self.high}]")
        return self

    @classmethod
    def constant(cls, value: float) -> Term:
        return cls(parts=(Part(function="one", coefficient=value),))

    @classmethod
    def linear(cls, **weights: float) -> Term:
        """``Term.linear(x=1)`` is the coordinate x."""
        return cls(parts=(Part(function="linear", weights=weights),))

    @classmethod
    def sin(cls, **weights: float) -> Term:
        return cls(parts=(Part(function="sin", weights=weights),))

    @classmethod
    def cos(cls, **weights: float) -> Term:
        return cls(parts=(Part(function="cos", weights=weights),))

    def clipped(self, low: float | None, high: float | None) -> Term:
        return self.model_copy(update={"low": low, "high": high})

    def __add__(self, other: Term) -> Term:
        require(
            self.low is None and self.high is None and other.low is None and other.high is None,
            "clipped terms can't be added",
        )
        return Term(parts=self.parts + other.parts)

    def __mul__(self, factor: float) -> Term:
        require(self.low is None and self.high is None, "a clipped term can't be scaled")
        parts = (p.model_copy(update={"coefficient": p.coefficient * factor}) for p in self.parts)
        return Term(parts=tuple(parts))

    __rmul__ = __mul__


class ObservationEntry(Frozen):
    """One entry of the observation: a name, the term that gives it, and the limits of the observation space."""

    name: Name
    term: Term
    low: Finite | None = None
    high: Finite | None = None


class Inequality(Frozen):
    """``term relation value``, for instance height > 1."""

    term: Term
    relation: Literal["<", "<=", ">", ">="]
    value: Number


AllOf = Annotated[tuple[Inequality, ...], Field(min_length=1, max_length=MAX_INEQUALITIES)]


def _termination_kind(value: object) -> str:
    return "learned" if isinstance(value, str) else "declared"


Termination = Annotated[
    Annotated[tuple[AllOf, ...], Field(max_length=MAX_INEQUALITIES), Tag("declared")]
    | Annotated[Literal["learned"], Tag("learned")],
    Discriminator(_termination_kind),
    Field(description="ends when any of these all-of groups holds at q'; or 'learned' from samples that ended"),
]


# Actions


class BoxAction(Frozen):
    """A continuous action in [low, high]. ``bins`` offers it to the policy as so many equally spaced discrete values a
    dimension (the paper's discretised control); the model and the sampler always see the continuous value."""

    kind: Literal["box"] = "box"
    low: tuple[Number, ...] = Field(min_length=1, max_length=MAX_DIMENSIONS)
    high: tuple[Number, ...] = Field(min_length=1, max_length=MAX_DIMENSIONS)
    bins: tuple[Annotated[int, Field(ge=2, le=MAX_DISCRETE_ACTIONS, strict=True)], ...] | None = None

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        require(
            len(self.low) == len(self.high),
            f"action low and high differ in length: {len(self.low)} and {len(self.high)}",
        )
        for i, (low, high) in enumerate(zip(self.low, self.high, strict=True)):
            require_range(f"action {i}", low, high)
        if self.bins is not None:
            require(len(self.bins) == len(self.low), f"expected {len(self.low)} bins, got {len(self.bins)}")
        return self

    @property
    def size(self) -> int:
        return len(self.low)


class DiscreteAction(Frozen):
    """One of n actions, 0 to n - 1."""

    kind: Literal["discrete"] = "discrete"
    n: int = Field(ge=2, le=MAX_DISCRETE_ACTIONS, strict=True)

    @property
    def size(self) -> int:
        return 1


class MultiDiscreteAction(Frozen):
    """Several discrete actions at once; entry i is 0 to nvec[i] - 1."""

    kind: Literal["multi_discrete"] = "multi_discrete"
    nvec: tuple[Annotated[int, Field(ge=2, le=MAX_DISCRETE_ACTIONS, strict=True)], ...] = Field(
        min_length=1, max_length=MAX_DIMENSIONS
    )

    @property
    def size(self) -> int:
        return len(self.nvec)


Action = Annotated[BoxAction | DiscreteAction | MultiDiscreteAction, Field(discriminator="kind")]


# Reward, success, design


class Reward(Frozen):
    """How the reward is learned, which is the rule.

    ``timing``: ``before`` reads (q, u), as Gymnasium's Pendulum does; ``after`` reads (q', u), as the paper says;
    ``auto`` takes, at each fit, the one that the evidence favours.
    ``penalty``: k of eq. 14, reward = mean - k * deviation; None takes the preset's (default 0, paper 3).
    """

    kind: Literal["learned"] = "learned"
    timing: Literal["before", "after", "auto"] = "before"
    penalty: Annotated[float, Field(ge=0, le=100, strict=True)] | None = None


class Quantity(Frozen):
    """What a declared reward measures: x = term(q) + action . u, ``action`` a weight for each entry of u."""

    term: Term | None = None
    action: tuple[Number, ...] = Field(default=(), max_length=MAX_DIMENSIONS)

    @model_validator(mode="after")
    def _something(self) -> Self:
        require(self.term is not None or bool(self.action), "a quantity needs a term or weights of the action")
        return self


class RewardTerm(Frozen):
    """weight * shape(of), where every inequality in ``when`` holds, else 0.

    ``one``: 1. ``linear``: sum of x. ``absolute``: sum of |x|. ``square``: sum of x^2. ``bump``: exp(-1/2 sum of x^2).
    """

    weight: Number = 1.0
    shape: Literal["one", "linear", "absolute", "square", "bump"]
    of: tuple[Quantity, ...] = Field(default=(), max_length=MAX_TERM_PARTS)
    when: tuple[Inequality, ...] = Field(default=(), max_length=MAX_INEQUALITIES)

    @model_validator(mode="after")
    def _measured(self) -> Self:
        if self.shape == "one":
            require(not self.of, "a reward term of shape 'one' takes no quantities")
        else:
            require(bool(self.of), f"a reward term of shape {self.shape!r} needs quantities to measure")
        return self


class DeclaredReward(Frozen):
    """A reward that is known: the sum of its terms, so no query is spent on it. Data, never evaluated as code.

    ``timing`` says which state the terms read; ``terminal`` is what a step that ends the episode pays beyond them.
    """

    kind: Literal["declared"]
    terms: tuple[RewardTerm, ...] = Field(min_length=1, max_length=MAX_TERM_PARTS)
    timing: Literal["before", "after"] = "before"
    terminal: Number = 0.0


def _reward_kind(value: object) -> object:
    return value.get("kind", "learned") if isinstance(value, dict) else getattr(value, "kind", "learned")


AnyReward = Annotated[
    Annotated[Reward, Tag("learned")] | Annotated[DeclaredReward, Tag("declared")], Discriminator(_reward_kind)
]


class Success(Frozen):
    """When an evaluation episode counts as a success. Every criterion given must hold.

    ``hold``: all inequalities hold through the last ``hold_steps`` steps; ``min_steps``: at least so many steps;
    ``max_steps``: at most; ``terminated``: the episode ended (or did not end) by termination; ``min_return``.
    """

    hold: tuple[Inequality, ...] = Field(default=(), max_length=MAX_INEQUALITIES)
    hold_steps: Count = 1
    min_steps: Count | None = None
    terminated: bool | None = None
    min_return: Number | None = None


class Design(Frozen):
    """The adaptive design of queries: what is chosen before the first one.

    ``preset``: ``default`` or ``paper`` (the method as printed, repaired only where it cannot work). Every None takes
    the preset's value. ``budget`` counts every real step of the design, initial ones included. ``tolerance`` is what
    eq. 9 divides by the deviation where none is declared: ``relative``, 5 % of the output's deviation over the initial
    design, or ``raw``, 1 in the output's own unit, as printed.
    """

    preset: Literal["default", "paper"] = "default"
    budget: Annotated[int, Field(ge=2, le=100_000, strict=True)] | None = None
    initial: Annotated[int, Field(ge=2, le=100_000, strict=True)] | None = None
    target: Annotated[float, Field(gt=0.5, lt=1, strict=True)] = 0.999
    acquisition: Literal["uncertainty_index", "variance", "integrated_variance", "latin_hypercube"] | None = None
    tolerance: Literal["relative", "raw"] | None = None
    monte_carlo: Annotated[int, Field(ge=16, le=100_000, strict=True)] | None = None
    seed: Annotated[int, Field(ge=0, lt=2**63, strict=True)] = 0


class EnvironmentSpec(Frozen):
    """One original environment: coordinates, observation, action, start, termination, and the design of queries."""

    environment: str = Field(default="", max_length=256, description="Gymnasium id, or free text for one's own")
    coordinates: tuple[Coordinate, ...] = Field(min_length=1, max_length=MAX_DIMENSIONS)
    observation: tuple[ObservationEntry, ...] = Field(min_length=1, max_length=MAX_DIMENSIONS)
    action: Action
    start: dict[Name, StartDistribution]
    termination: Termination = ()
    time_limit: Annotated[int, Field(ge=1, le=10_000_000, strict=True)] | None = None
    query: Literal["step", "rollout"] = Field(
        default="step",
        description="``step``: it can be set to any state; ``rollout``: it can only be reset, and acted on from there",
    )
    max_rollout: Annotated[int, Field(ge=1, le=MAX_ROLLOUT_QUERY, strict=True)] | None = Field(
        default=None, description="longest action sequence of one query; None: the time limit, 200 at most"
    )
    reward: AnyReward = Reward()
    tolerances: dict[Name, Positive] = Field(
        default_factory=dict,
        description="by moving coordinate (preset paper: by observation entry), or 'reward', in the output's own unit",
    )
    success: Success | None = None
    design: Design = Design()

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.coordinates)

    @property
    def termination_groups(self) -> tuple[AllOf, ...]:
        """Declared terminations; none where termination is learned."""
        return () if self.termination == "learned" else self.termination

    @property
    def observation_names(self) -> tuple[str, ...]:
        return tuple(o.name for o in self.observation)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        names = self.coordinate_names
        require_unique("coordinate", names)
        require_unique("observation", self.observation_names)
        outputs = names if self.design.preset == "default" else (*names, *self.observation_names)
        require(REWARD not in outputs, f"nothing that is learned beside the reward may be called {REWARD!r}")
        require_known("start", self.start, names)
        missing = [n for n in names if n not in self.start]
        require(not missing, f"start distribution lacks {missing}: expected every coordinate of {list(names)}")
        moving = [c.name for c in self.coordinates if c.kind != "constant"]
        require(bool(moving), "expected at least one coordinate that moves (linear or angle)")
        learned = moving if self.design.preset == "default" else self.observation_names
        require_known("tolerances", self.tolerances, (*learned, REWARD))
        for c in self.coordinates:
            if c.bounds is not None:
                if c.bounds.stops is not None:
                    require_known(f"coordinate {c.name!r}: stops", (c.bounds.stops,), moving)
                    self._require_stoppable(c.name, c.bounds.stops)
                low, high = limits(self.start[c.name])
                inside = (c.bounds.low is None or low >= c.bounds.low) and (
                    c.bounds.high is None or high <= c.bounds.high
                )
                require(
                    inside, f"start of {c.name!r}, [{low}, {high}], leaves its bounds [{c.bounds.low}, {c.bounds.high}]"
                )
        self._require_reward()
        for where, term in self._terms():
            for part in term.parts:
                require_known(f"{where}: term", part.weights, names)
        for entry in self.observation:
            low = -math.inf if entry.low is None else entry.low
            high = math.inf if entry.high is None else entry.high
            require(low < high, f"observation {entry.name!r} crosses: expected low < high, got [{low}, {high}]")
        require(
            self.max_rollout is None or self.query == "rollout",
            f"max_rollout {self.max_rollout} needs query 'rollout', got {self.query!r}",
        )
        require(
            self.query == "step" or self.design.preset != "paper",
            "preset 'paper' starts from a Latin hypercube over states: expected query 'step', got 'rollout'",
        )
        if self.design.budget is not None and self.design.initial is not None:
            require(
                self.design.initial <= self.design.budget,
                f"design: initial {self.design.initial} exceeds the budget {self.design.budget}",
            )
        return self

    def _require_reward(self) -> None:
        if not isinstance(self.reward, DeclaredReward):
            return
        lengths = {len(quantity.action) for term in self.reward.terms for quantity in term.of} - {0}
        require(
            lengths <= {self.action.size},
            f"reward: expected {self.action.size} weights of the action, got {sorted(lengths)}",
        )
        require(self.design.preset == "default", "preset 'paper' learns its reward: expected one of kind 'learned'")

    def _require_stoppable(self, name: str, stopped: str) -> None:
        require(stopped != name, f"coordinate {name!r} stops itself: expected another one")
        bounds = self.coordinates[self.coordinate_names.index(stopped)].bounds
        if bounds is not None:
            holds = (bounds.low is None or bounds.low <= 0) and (bounds.high is None or bounds.high >= 0)
            require(holds, f"coordinate {name!r} sets {stopped!r} to 0, outside its [{bounds.low}, {bounds.high}]")

    def _terms(self) -> Iterable[tuple[str, Term]]:
        for entry in self.observation:
            yield f"observation {entry.name!r}", entry.term
        for group in self.termination_groups:
            for inequality in group:
                yield "termination", inequality.term
        if self.success is not None:
            for inequality in self.success.hold:
                yield "success", inequality.term
        if isinstance(self.reward, DeclaredReward):
            for paying in self.reward.terms:
                yield from (("reward", quantity.term) for quantity in paying.of if quantity.term is not None)
                yield from (("reward", inequality.term) for inequality in paying.when)
