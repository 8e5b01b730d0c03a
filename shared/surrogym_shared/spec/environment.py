"""Specification of an original environment, and checks that its parts don't contradict each other."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, StrictBool, StrictFloat, StrictInt, StrictStr, model_validator

from surrogym_shared.checks import SHOWN, Number, Positive, require, require_known, require_unique
from surrogym_shared.kinds import Access
from surrogym_shared.patterns import VISIBLE
from surrogym_shared.presets import PRESETS, Preset, PresetName, Tolerance
from surrogym_shared.spec.actions import Action, BoxAction, DiscreteAction
from surrogym_shared.spec.base import (
    MAX_DIMENSIONS,
    MAX_ROLLOUT_QUERY,
    MAX_STARTS,
    MOST_PLANNED,
    MOST_PLANNED_ENTRIES,
    REWARD,
    Frozen,
    Name,
    ends_of,
)
from surrogym_shared.spec.coordinates import Coordinate, StartDistribution, limits
from surrogym_shared.spec.rewards import AnyReward, DeclaredReward, Reward, Success
from surrogym_shared.spec.safety import Limits
from surrogym_shared.spec.terms import AllOf, ObservationEntry, Term, Termination


def _require_setting(value: object) -> object:
    """Return a setting. Raise ``ValueError`` if it has none of the allowed types, of which pydantic's error would name
    only one."""
    allowed = isinstance(value, bool | int | str) or (isinstance(value, float) and math.isfinite(value))
    require(allowed, f"expected a finite number, true, false or a text, got {str(value)[:SHOWN]}")
    return value


Setting = Annotated[StrictBool | StrictInt | StrictFloat | StrictStr, BeforeValidator(_require_setting)]


class Choice(Frozen):
    """Choice of a component by its name, such as a family of models, with the settings of this component."""

    name: Name
    settings: dict[Name, Setting] = Field(default_factory=dict, max_length=64)


class AcquisitionChoice(Choice):
    """Choice of an acquisition, the criterion for the next query, with its settings."""


class ModelChoice(Choice):
    """Choice of a family of models, with its settings."""


class Design(Frozen):
    """Settings of the adaptive design of queries. A field of None takes the preset's value.

    ``preset``: ``default``, or ``paper``, the method as the paper has it, changed only where it can't work.

    ``budget``: number of real steps of the design, with the initial ones. With 0 the design takes no real steps, and
    the model is learned from a log.

    ``initial``: number of real steps before the first model. Their queries form a Latin hypercube.

    ``acquisition``: criterion that chooses the queries after the initial ones, by name or with settings.
    ``integrated_variance``, the default, takes the query that lowers the variance most, averaged over the sampling
    range and over states that policies visited. ``variance`` takes the query with the largest standard deviation.
    ``uncertainty_index`` is the criterion of the paper (eq. 12). ``latin_hypercube`` takes the whole budget as one
    Latin hypercube, whatever ``initial`` is; if the budget is raised later, further steps go to the largest gaps. A
    package on the server may add others.

    ``model``: family of models. ``gaussian_process`` is the default. ``sparse_gaussian_process``, the same with the
    setting ``inducing`` of 300, is for thousands of steps. ``ensemble`` is an ensemble of neural networks. A package on
    the server may add others.

    ``tolerance``: error of an output that does not matter (numerator of eq. 9), for outputs without a declared
    tolerance. ``relative`` is 5 % of the output's standard deviation over the initial design, ``raw`` is 1 in the
    output's own unit, as in the paper.

    ``symmetry``: ``auto`` tests whether the environment is its own mirror image: whether all changes have the opposite
    sign if all coordinates and the action have. ``none``, and the preset ``paper``, don't test this.

    ``monte_carlo``: number of points that estimate the confidence index (eq. 8).
    """

    preset: PresetName = "default"
    budget: Annotated[int, Field(ge=0, le=100_000, strict=True)] | None = None
    initial: Annotated[int, Field(ge=2, le=100_000, strict=True)] | None = None
    target: Annotated[float, Field(gt=0.5, lt=1, strict=True)] = 0.999
    acquisition: Name | AcquisitionChoice | None = None
    model: Name | ModelChoice | None = None
    tolerance: Tolerance | None = None
    monte_carlo: Annotated[int, Field(ge=16, le=100_000, strict=True)] | None = None
    symmetry: Literal["auto", "none"] = "auto"
    seed: Annotated[int, Field(ge=0, lt=2**63, strict=True)] = 0


class EnvironmentSpec(Frozen):
    """Specification of one original environment: coordinates, observation, action, start, termination, and design of
    queries."""

    environment: str = Field(
        default="",
        max_length=256,
        pattern=VISIBLE,
        description="name of the environment, such as a Gymnasium id or ``module:Class``, or a text that describes it",
    )
    coordinates: tuple[Coordinate, ...] = Field(min_length=1, max_length=MAX_DIMENSIONS)
    observation: tuple[ObservationEntry, ...] = Field(min_length=1, max_length=MAX_DIMENSIONS)
    action: Action
    start: dict[Name, StartDistribution]
    starts: tuple[tuple[Number, ...], ...] = Field(
        default=(),
        max_length=MAX_STARTS,
        description="states (C,) at which episodes start, all equally likely, instead of ``start``; used for logs as a "
        "rule",
    )
    termination: Termination = ()
    time_limit: Annotated[int, Field(ge=1, le=10_000_000, strict=True)] | None = None
    sampling_period: Positive | None = Field(
        default=None, description="seconds from one step to the next; None: unknown"
    )
    outside_reward: Number | None = Field(
        default=None,
        description="if given, a virtual episode ends where it leaves the sampling ranges, or where the session's "
        "model is too uncertain (``trust``), and this reward is paid for each step that is then missing up to the time "
        "limit; None: the episode continues",
    )
    limits: Limits | None = Field(
        default=None,
        description="ranges that the state must not leave, and the action that a fallback takes near their ends",
    )
    query: Literal["step", "rollout"] = Field(
        default="step",
        description="``step``: the environment can be set to any state, and a query is one step from a state; "
        "``rollout``: it can't, and a query is an action sequence from a reset or a saved state",
    )
    snapshots: StrictBool = Field(
        default=False,
        description="with query ``rollout``: whether the environment can save a state that it is in, and return to it",
    )
    max_rollout: Annotated[int, Field(ge=1, le=MAX_ROLLOUT_QUERY, strict=True)] | None = Field(
        default=None, description="largest number of actions of one query; None: the time limit, but at most 200"
    )
    reward: AnyReward = Reward()
    tolerances: dict[Name, Positive] = Field(
        default_factory=dict,
        description="error that does not matter, in the output's unit, by moving coordinate (preset paper: by "
        "observation entry) or 'reward'",
    )
    success: Success | None = None
    design: Design = Design()

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.coordinates)

    @property
    def termination_groups(self) -> tuple[AllOf, ...]:
        """Groups of inequalities: an episode terminates when all of a group hold. Empty if termination is learned."""
        return () if self.termination == "learned" else self.termination

    @property
    def needs_trials(self) -> bool:
        """Whether a design leaves steps to trials of trained policies: the environment can only be reset, has more
        coordinates than most planners can steer through, and no planner fits. Declared limits hold in a trial, too,
        because the sampler keeps them."""
        return self.access == "reset" and len(self.coordinates) > MOST_PLANNED and not self.fits_planner

    @property
    def repeats_actions(self) -> tuple[bool, ...]:
        """Whether each of the C coordinates repeats an earlier action."""
        names: set[str] = set()
        for c in self.coordinates:
            if c.lag is not None and (c.lag.kind == "action" or c.lag.of in names):
                names.add(c.name)
        return tuple(c.name in names for c in self.coordinates)

    @property
    def fits_planner(self) -> bool:
        """Whether a planner can act in the environment, as far as the specification says: with few coordinates besides
        those that repeat actions, through which a planner looks, and with few entries of an action that may change at
        once."""
        kept = 1 + max(i for i, repeats in enumerate(self.repeats_actions) if not repeats)
        action, fits = self.action, isinstance(self.action, DiscreteAction)
        if isinstance(action, BoxAction):
            fits = action.size <= MOST_PLANNED_ENTRIES and not action.bins and not any(action.rate or ())
        return kept <= MOST_PLANNED and fits and self.outside_reward is None

    @property
    def access(self) -> Access:
        """Where a query may begin: at any state, at a saved state or a reset, or at a reset only."""
        if self.query == "step":
            return "any"
        return "snapshot" if self.snapshots else "reset"

    @property
    def observation_names(self) -> tuple[str, ...]:
        return tuple(o.name for o in self.observation)

    @property
    def unknown_steps(self) -> int:
        """Number of first steps of an episode from which a model does not learn, because lags (past values) are
        unknown."""
        return max(c.counted for c in self.coordinates)

    @property
    def preset(self) -> Preset:
        """Preset of the design, which has a value for each setting that the specification leaves out."""
        return PRESETS[self.design.preset]

    def known(self, coordinates: Sequence[float]) -> bool:
        """Whether all lags (past values) in a state (C,) are known, so that a model can learn from a step there."""
        return all(q >= c.counted for c, q in zip(self.coordinates, coordinates, strict=True) if c.counted)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        names = self.coordinate_names
        require_unique("coordinate", names)
        require_unique("observation", self.observation_names)
        outputs = names if self.preset.moves == "coordinates" else (*names, *self.observation_names)
        require(REWARD not in outputs, f"a coordinate or observation entry must not be called {REWARD!r}")
        require_known("start", self.start, names)
        missing = [n for n in names if n not in self.start]
        require(not missing, f"start distribution lacks {missing}: expected every coordinate of {list(names)}")
        moving = [c.name for c in self.coordinates if c.moves]
        require(bool(moving), "expected at least one coordinate that moves (linear or angle)")
        self._require_lags()
        learned_names = moving if self.preset.moves == "coordinates" else self.observation_names
        require_known("tolerances", self.tolerances, (*learned_names, REWARD))
        for c in self.coordinates:
            if c.bounds is not None:
                if c.bounds.stops is not None:
                    require_known(f"coordinate {c.name!r}: stops", (c.bounds.stops,), moving)
                    self._require_stoppable(c.name, c.bounds.stops)
                (least, most), (low, high) = c.saturation, limits(self.start[c.name])
                require(
                    least <= low and high <= most,
                    f"start of {c.name!r}, [{low}, {high}], leaves its bounds [{c.bounds.low}, {c.bounds.high}]",
                )
        for start in self.starts:
            require(len(start) == len(names), f"starts: expected {len(names)} entries, got {len(start)}")
        require(
            self.outside_reward is None or self.time_limit is not None,
            "outside_reward is paid for each step up to the time limit: expected a time_limit, got none",
        )
        self._require_reward()
        for where, term in self._terms():
            for part in term.parts:
                require_known(f"{where}: term", part.weights, names)
        for entry in self.observation:
            low, high = ends_of(entry.low, entry.high)
            require(low < high, f"limits of observation {entry.name!r}: expected low < high, got [{low}, {high}]")
        require(
            self.max_rollout is None or self.query == "rollout",
            f"max_rollout {self.max_rollout} needs query 'rollout' (--access reset or snapshot), got {self.query!r}",
        )
        require(
            not self.snapshots or self.query == "rollout",
            f"snapshots need query 'rollout', got {self.query!r}, with which any state can be set: leave snapshots out",
        )
        require(
            self.query == "step" or self.preset.takes_rollouts,
            f"preset {self.preset.name!r} starts at a Latin hypercube of states: expected query 'step', got 'rollout'",
        )
        require(self.design.budget != 1, "design: expected a budget of 2 or more real steps, or 0 for none, got 1")
        if self.design.budget and self.design.initial is not None:
            require(
                self.design.initial <= self.design.budget,
                f"design: initial {self.design.initial} exceeds the budget {self.design.budget}",
            )
        if isinstance(self.action, BoxAction) and self.action.rate is not None:
            from surrogym_shared.rates import rates

            rates(self)
        if self.limits is not None:
            from surrogym_shared.limits import check_limits

            check_limits(self)
        return self

    def _require_lags(self) -> None:
        """Check that each lag (past value) repeats a known value, that it looks back less far than an episode, and that
        queries are rollouts if there are lags."""
        earlier: dict[str, Coordinate] = {}
        age = dict.fromkeys(self.coordinate_names, 0)
        longest = min((limit for limit in (self.time_limit, self.max_rollout) if limit is not None), default=math.inf)
        for c in self.coordinates:
            if c.lag is not None:
                where = f"coordinate {c.name!r}: lag"
                require(
                    self.query == "rollout",
                    f"{where}: an environment that is set to a state has no past, so lags need one that can only be "
                    "reset: expected query 'rollout', got 'step'",
                )
                if c.lag.kind == "steps":
                    twice = any(k.counted for k in earlier.values())
                    require(not twice, f"{where}: expected one coordinate of kind 'steps', got two")
                elif c.lag.entry is not None:
                    size = self.action.size
                    require(c.lag.entry < size, f"{where}: expected an entry below {size}, got {c.lag.entry}")
                else:
                    sources = [
                        n for n, k in earlier.items() if (k.moves if c.lag.kind == "change" else k.kind == "linear")
                    ]
                    rule = "of an earlier coordinate; lags of an angle are of kind 'change'"
                    require_known(f"{where} ({rule})", (c.lag.of or "",), sources)
                age[c.name] = 1 + age[c.lag.of or c.name]
                require(
                    age[c.name] < longest,
                    f"{where}: looks {age[c.name]} steps back: expected fewer than an episode's {longest}",
                )
            earlier[c.name] = c
        for name, steps in (("budget", self.design.budget), ("initial", self.design.initial)):
            require(
                not self.unknown_steps or not steps or steps > self.unknown_steps + 1,
                f"design: nothing is learned from the first {self.unknown_steps} steps of an episode, because "
                "their lags are unknown: expected "
                f"{name} of more than {self.unknown_steps + 1}, got {steps}",
            )

    def _require_reward(self) -> None:
        if not isinstance(self.reward, DeclaredReward):
            return
        lengths = {len(quantity.action) for term in self.reward.terms for quantity in term.of} - {0}
        require(
            lengths <= {self.action.size},
            f"reward: expected {self.action.size} weights of the action, got {sorted(lengths)}",
        )
        require(
            self.preset.takes_declared_rewards,
            f"preset {self.preset.name!r} learns its reward: expected a reward of kind 'learned', got 'declared'",
        )

    def _require_stoppable(self, name: str, stopped: str) -> None:
        require(stopped != name, f"coordinate {name!r}: expected another coordinate in its bounds' stops, got itself")
        coordinate = self.coordinates[self.coordinate_names.index(stopped)]
        (low, high), bounds = coordinate.saturation, coordinate.bounds
        if bounds is not None:
            require(
                low <= 0 <= high,
                f"coordinate {name!r} sets {stopped!r} to 0 at its bounds: expected bounds of {stopped!r} that contain "
                f"0, got [{bounds.low}, {bounds.high}]",
            )

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
