"""EnvironmentDefinition: one environment in the form with which models and designs compute.

A specification (``surrogym_shared.spec``) is what a person writes: it leaves defaults open, and is checked when it is
made. A definition is derived from it, only in ``convert.definitions``: it has every default. Its coordinates,
distributions, terms, actions, rewards and limits are those of the specification, which name coordinates. What a step
needs is compiled from them when it is first used, with an index in place of each name.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.conditions import Conditions
from surrogym_server.environment.declared_reward import RewardFunction
from surrogym_server.environment.distributions import Distribution, quantiles
from surrogym_server.environment.safety import LimitSet
from surrogym_server.environment.terms import TermSet, compile_terms
from surrogym_server.errors import InvalidInput
from surrogym_server.plugins import Choice
from surrogym_server.tensors import CPU, cached, to_device
from surrogym_shared.kinds import RewardTiming
from surrogym_shared.presets import InputProbability, Moves, Stopping, Tolerance
from surrogym_shared.rates import Rate
from surrogym_shared.set_points import reward_for
from surrogym_shared.spec import (
    REWARD,
    Action,
    Coordinate,
    DeclaredReward,
    Inequality,
    Limits,
    ObservationEntry,
    Reward,
    limits,
)

REACH = 1e6  # a prediction without a bound is clipped at this many widths of the sampling range beyond that range
SCALING_POINTS = 4_096  # mean and standard deviation of the observation are computed from this many sampled states
Array = NDArray[np.float64]


@dataclass(frozen=True)
class LearningDefinition:
    """Settings of model learning, with every default filled in.

    Attributes:
        model: family of models, by its name in ``models.registry``, and its settings.
        moves: whether the model predicts increments of the ``coordinates`` or of the ``observation``. With
            ``observation``, the next coordinates are computed from the predicted observation, as in the paper.
        limits_rewards: whether rewards of virtual steps are clipped to limits that follow from the rewards of the
            samples.
    """

    model: Choice
    moves: Moves
    limits_rewards: bool = True


@dataclass(frozen=True)
class DesignDefinition:
    """Settings of the adaptive design, with every default filled in.

    Attributes:
        initial: number of queries of the initial design.
        hypercube_tries: number of random Latin hypercubes. The one whose closest two points are farthest apart is used.
        acquisition: criterion of the adaptive queries.
        tolerance: default tolerance of an output: ``relative`` is 5 % of its standard deviation over the initial
            design, ``raw`` is 1 in its unit.
        monte_carlo: number of points that estimate the confidence index (eq. 8).
        visited_candidates: whether states that policies visited are added to the candidates and the reference points.
        input_probability: P_i (eq. 11) before a policy has visited any state: ``uniform``, or ``predicted``, the
            density of the predicted next states, as in the paper.
        stopping: ``confidence`` stops when the confidence index reaches its target, as in the paper.
            ``tested_confidence`` also requires leave-one-out errors within the tolerances, and answers to adaptive
            queries, which could have disproved the model.
        seed: seed of all random choices of the design.
        trials: whether the rest of the budget is left to trials of policies, because only these can steer.
    """

    initial: int
    hypercube_tries: int
    acquisition: Choice
    tolerance: Tolerance
    monte_carlo: int
    visited_candidates: bool
    input_probability: InputProbability
    stopping: Stopping
    seed: int
    trials: bool = False


@dataclass(frozen=True)
class EnvironmentDefinition:
    """One environment, with C coordinates, D observation entries and F action entries."""

    coordinates: tuple[Coordinate, ...]
    start: tuple[Distribution, ...]  # (C,) distribution of each coordinate in the first state of an episode
    observation: tuple[ObservationEntry, ...]
    action: Action
    termination_groups: tuple[tuple[Inequality, ...], ...]
    time_limit: int | None
    reward: Reward | DeclaredReward
    # Factor k of eq. 14: a predicted reward is reduced by this multiple of its standard deviation; 0 if it is declared.
    penalty: float
    tolerances: tuple[tuple[str, float], ...]
    learning: LearningDefinition
    design: DesignDefinition
    # Whether a model learns from samples which states are terminal. Then ``termination_groups`` is empty.
    learns_termination: bool = False
    # Largest number of actions in a query, which is then a rollout. None if the original environment can be set to any
    # state, so that a query is a single step.
    max_rollout: int | None = None
    snapshots: bool = False  # whether a query may begin at a snapshot (a saved state) instead of a reset
    # States at which episodes start; if there are none, starts are drawn from the distributions ``start``.
    starts: tuple[tuple[float, ...], ...] = ()
    # A virtual episode that leaves the sampling range ends, and gets this reward for each step up to the time limit.
    # None: leaving the range does not end an episode.
    outside_reward: float | None = None
    limits: Limits | None = None  # declared limits within which the original environment has to stay
    rates: tuple[Rate, ...] = ()  # largest changes of action entries per step; empty: no limits
    device: torch.device = CPU  # device of the definition's tensors, and of states and actions that are passed to it

    def on(self, device: torch.device) -> EnvironmentDefinition:
        """Return the same definition for states on another device."""
        return self if device == self.device else to_device(self, device)

    def tolerances_or(self, defaults: Sequence[float]) -> tuple[float, ...]:
        """Return the tolerances of the O outputs: the declared ones, and those in ``defaults`` (O,) for outputs without
        a declared tolerance."""
        declared = dict(self.tolerances)
        return tuple(declared.get(name, value) for name, value in zip(self.outputs, defaults, strict=True))

    def with_tolerances(self, tolerances: Mapping[str, float]) -> EnvironmentDefinition:
        """Return the same definition with ``tolerances``, by output name, set; those of other outputs are kept."""
        return replace(self, tolerances=tuple((dict(self.tolerances) | dict(tolerances)).items()))

    def with_set_points(self, points: Iterable[tuple[str, float]]) -> EnvironmentDefinition:
        """Return the same definition with other set points of the declared reward, given by coordinate.

        Raises:
            InvalidInput: the reward or the model does not support a set point, with the reason.
        """
        if not (given := dict(points)):
            return self
        try:
            return replace(self, reward=reward_for(self, given))
        except ValueError as error:
            raise InvalidInput(str(error)) from error

    @property
    def moves_observation(self) -> bool:
        """Whether the model predicts changes of the observation instead of changes of the coordinates."""
        return self.learning.moves == "observation"

    @cached_property
    def coordinate_names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.coordinates)

    @cached_property
    def action_limits(self) -> tuple[Array, Array]:
        """Lowest and highest value of each action entry, (F,) each; cached, because each action of a policy is compared
        with them."""
        low, high = np.array(self.action.ranges).T
        return low, high

    @cached_property
    def observation_names(self) -> tuple[str, ...]:
        return tuple(o.name for o in self.observation)

    @property
    def reward_timing(self) -> RewardTiming:
        return self.reward.timing

    @cached
    def declared_reward(self) -> RewardFunction | None:
        """The declared reward as a function of states and actions; None if the reward is learned."""
        if not isinstance(self.reward, DeclaredReward):
            return None
        return RewardFunction.of(self.reward, self.coordinate_names, self.action.size, self.device)

    @cached_property
    def moving(self) -> tuple[int, ...]:
        """Indices of the coordinates that the dynamics move: all except constants and lags (they repeat a past
        value)."""
        return tuple(i for i, c in enumerate(self.coordinates) if c.moves)

    @cached_property
    def lags(self) -> tuple[int, ...]:
        """Indices of the coordinates that repeat a past value."""
        return tuple(i for i, c in enumerate(self.coordinates) if c.lag is not None)

    @cached_property
    def repeated_actions(self) -> NDArray[np.int64]:
        """Index, action entry and age of each coordinate that repeats an action, (L, 3)."""
        size, found = len(self.coordinates), []
        for index in self.lags:
            source = self.sources[index]
            while source < size and self.sources[source] != source:
                source = self.sources[source]
            if source >= size:
                found.append((index, source - size, self.ages[index]))
        return np.array(found, dtype=np.int64).reshape(-1, 3)

    @property
    def kept(self) -> int:
        """Number of the first coordinates up to the last one that repeats no action."""
        repeated = set(self.repeated_actions[:, 0].tolist())
        return 1 + max(i for i in range(len(self.coordinates)) if i not in repeated)

    @cached_property
    def ages(self) -> tuple[int, ...]:
        """Number of steps that each coordinate looks back, (C,); 0 for coordinates that repeat no past value."""
        ages: list[int] = []
        for c, source in zip(self.coordinates, self.sources, strict=True):
            if c.lag is None or c.lag.kind == "steps":
                ages.append(0)
            else:
                ages.append(1 + (ages[source] if c.lag.kind == "value" else 0))
        return tuple(ages)

    @cached_property
    def sources(self) -> tuple[int, ...]:
        """Index, in [coordinates, action], of the value that each coordinate repeats if it is a lag, (C,): a coordinate
        or an action entry of the past. A counter of steps, and a coordinate that is no lag, has its own index."""
        names = self.coordinate_names
        sources: list[int] = []
        for index, c in enumerate(self.coordinates):
            if c.lag is None or c.lag.kind == "steps":
                sources.append(index)
            else:
                sources.append(names.index(c.lag.of) if c.lag.entry is None else len(names) + c.lag.entry)
        return tuple(sources)

    @cached_property
    def stopped(self) -> tuple[int | None, ...]:
        """Index of the coordinate that becomes 0 at the bounds of each coordinate, such as the speed at a wall, (C,);
        None for a coordinate that is no wall."""
        stops = [None if c.bounds is None else c.bounds.stops for c in self.coordinates]
        return tuple(None if name is None else self.coordinate_names.index(name) for name in stops)

    @cached_property
    def counter(self) -> int | None:
        """Index of the coordinate that counts the steps since a reset; None if there is none."""
        return next((i for i, c in enumerate(self.coordinates) if c.counted), None)

    @property
    def unknown_steps(self) -> int:
        """Number of steps at the beginning of an episode from which a model does not learn, because lags (coordinates
        that repeat a past value) are not known yet."""
        return max(c.counted for c in self.coordinates)

    def known(self, q: Tensor) -> Tensor:
        """Return for which of the states q (..., C) all lags are known, (...) bool. A lag is a coordinate that repeats
        a past value."""
        if self.counter is None:
            return torch.ones(q.shape[:-1], dtype=torch.bool, device=q.device)
        return q[..., self.counter] >= self.unknown_steps

    @cached
    def lag_columns(self) -> Tensor:
        """Indices of the coordinates that repeat a past value, as a tensor on the device."""
        return torch.tensor(self.lags, device=self.device)

    @cached
    def moving_columns(self) -> Tensor:
        """Indices of the coordinates that the dynamics move, as a tensor on the device."""
        return torch.tensor(self.moving, device=self.device)

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        """Names of the modelled outputs: the moving coordinates or the observation entries, then the reward."""
        if self.moves_observation:
            return (*self.observation_names, REWARD)
        return (*(self.coordinates[i].name for i in self.moving), REWARD)

    @cached_property
    def encoders(self) -> dict[Any, Any]:
        """What ``features.encode`` has made for each feature map: its encoder, and the places of its features."""
        return {}

    @cached
    def observe(self) -> TermSet:
        """Function that computes the observations o (..., D) of coordinates q (..., C)."""
        return to_device(compile_terms([o.term for o in self.observation], self.coordinate_names), self.device)

    @cached_property
    def observation_combines(self) -> bool:
        """Whether any observation entry is a sum of several functions, or a function of several coordinates."""
        sums = [o.term.parts for o in self.observation]
        return any(len(parts) > 1 or any(sum(map(bool, p.weights.values())) > 1 for p in parts) for parts in sums)

    @cached
    def observation_scaling(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the observation over the sampling range, (D,) each. An entry that never varies
        has standard deviation 1."""
        probabilities = np.random.default_rng(0).uniform(size=(SCALING_POINTS, len(self.coordinates)))
        p = torch.from_numpy(probabilities).to(self.device)
        shown = self.observe(quantiles([c.sampling for c in self.coordinates], p))
        std = shown.std(0, correction=0)
        return shown.mean(0), torch.where(std > 1e-9, std, 1.0)

    @cached
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper saturation bounds, (C,) each."""
        low, high = self._columns([c.saturation for c in self.coordinates])
        return low, high

    @cached
    def reach(self) -> tuple[Tensor, Tensor]:
        """Lower and upper limits to which predicted coordinates are clipped, (C,) each, so that they stay finite even
        if the model diverges.

        A limit is the saturation bound. On a side without a bound it lies ``REACH`` times the width of the sampling
        range beyond that range.
        """
        low, high = self.bounds
        begin, end = self.sampled
        room = REACH * (end - begin)
        return torch.maximum(low, begin - room), torch.minimum(high, end + room)

    def in_range(self, q: Tensor) -> Tensor:
        """Return whether states q (..., C) lie in the sampling range, (...) bool."""
        low, high = self.sampled
        inside: Tensor = ((q >= low) & (q <= high)).all(-1)
        return inside

    def can_be_set(self, q: Tensor) -> Tensor:
        """Return (n,) bool: whether the original environment can be set to each of n states q (n, C)."""
        low, high = torch.tensor([c.settable for c in self.coordinates], dtype=q.dtype, device=q.device).T
        inside: Tensor = ((q >= low) & (q <= high)).all(-1)
        return inside

    @cached_property
    def angles(self) -> tuple[int, ...]:
        return tuple(i for i, c in enumerate(self.coordinates) if c.kind == "angle")

    def terminated(self, q: Tensor) -> Tensor:
        """Return whether the declared termination holds at q (..., C), (...) bool. It holds if all inequalities of at
        least one group hold."""
        if not self.termination_groups:
            return torch.zeros(q.shape[:-1], dtype=torch.bool, device=q.device)
        return self._termination(q).any(-1)

    def within_rates(self, q: Tensor, u: Tensor) -> Tensor:
        """Return the actions (n, F) that are nearest to actions u (n, F) and within the declared rates: the largest
        changes of action entries from the step before. States q (n, C) contain the previous values of these entries."""
        if not self.rates:
            return u
        kept = u.to(q.dtype, copy=True)
        for rate in self.rates:
            last = q[:, rate.last]
            kept[:, rate.entry] = torch.clamp(kept[:, rate.entry], last - rate.change, last + rate.change)
        return kept

    def falls_back(self, q: Tensor, q_next: Tensor) -> Tensor:
        """Return whether the fallback action that the limits declare takes over after a step from q (..., C) to q_next
        (..., C), (...) bool. Without limits it never does."""
        if self.limits is None:
            return torch.zeros(q_next.shape[:-1], dtype=torch.bool, device=q_next.device)
        return self._limits.falls_back(q, q_next)

    def with_fallback(self, q: Tensor, u: Tensor) -> Tensor:
        """Return the actions (n, F) at states q (n, C): those of the declared fallback within the margin of a limit;
        elsewhere, or if the fallback is a program, u (n, F)."""
        if self.limits is None or not isinstance(self.limits.fallback, tuple):
            return u
        low, high = (torch.as_tensor(ends, dtype=u.dtype) for ends in self.action_limits)
        chosen = compile_terms(self.limits.fallback, self.coordinate_names)(q).clamp(low, high)
        return torch.where(self.falls_back(q, q)[:, None], chosen, u)

    def room(self, q: Tensor) -> Tensor:
        """Return for L declared limits, each a range of a function of the state, how far states q (..., C) are from the
        nearer end of the range, (..., L). The distance is negative outside the range."""
        return self._limits.room(q)

    @cached
    def _limits(self) -> LimitSet:
        assert self.limits is not None
        return LimitSet.of(self.limits.keep, self.coordinate_names, self.device)

    @cached
    def _termination(self) -> Conditions:
        return Conditions.of(self.termination_groups, self.coordinate_names, self.device)

    @cached
    def start_states(self) -> Tensor:
        """States at which episodes start, (k, C); k is 0 if starts are drawn from distributions instead."""
        return torch.tensor(self.starts, dtype=torch.float64, device=self.device).reshape(-1, len(self.coordinates))

    @cached
    def sampled(self) -> tuple[Tensor, Tensor]:
        """Lower and upper ends of the sampling range, (C,) each."""
        low, high = self._columns([limits(c.sampling) for c in self.coordinates])
        return low, high

    def _columns(self, rows: Sequence[tuple[float, ...]]) -> tuple[Tensor, ...]:
        return torch.tensor(rows, dtype=torch.float64, device=self.device).T.contiguous().unbind()


def wrap(angle: Tensor) -> Tensor:
    """Wrap an angle in radians to [-pi, pi)."""
    return torch.remainder(angle + torch.pi, 2 * torch.pi) - torch.pi
