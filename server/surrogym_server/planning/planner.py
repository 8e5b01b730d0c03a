"""``Planner``: a policy that plans each action by rollouts of a model around a policy on a grid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_server.compiled.threads import side_by_side
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.observation_inverse import ObservationInverse
from surrogym_server.errors import InvalidInput
from surrogym_server.models.abilities import ArraySteps, CompiledSteps, GridPolicy, PlannedActions, offers
from surrogym_server.models.port import DynamicsModel, with_set_points
from surrogym_server.planning.grid import solve, unfit
from surrogym_server.planning.pending import PendingActions
from surrogym_server.planning.state_filter import StateFilter, apart
from surrogym_shared.spec import MOST_HORIZON, BoxAction, Limit

Floats = NDArray[np.float64]

ROUNDS, ROLLOUTS, ELITE = 3, 24, 4
SPREAD = 0.3  # standard deviation of the changes of a continuous action, as a share of half its range
NARROWING = 0.5  # factor of this standard deviation from one round to the next
COLOUR = 0.8  # correlation of the changes of two steps in a row
STATES = 4  # smallest number of states for which a thread plans
SETS = 64  # number of sets of changes, which the decisions take in turns
LENGTHS, BEGINNINGS = (1, 1, 2, 3, 5), (0, 0, 0, 1, 2, 4, 7)  # changes of a discrete action: steps, and first step
# A plan of an earlier decision is continued if the state lies within this share of each coordinate's sampling range
# from the state that the plan predicted.
NEAR = 0.1
# A lasting error of the predicted change is estimated from steps in which no coordinate moves by more than this share
# of its sampling range. An error in faster motion says little about the error at rest.
STILL = 0.02
GAIN = 0.1  # share of the error of such a step by which the estimate changes, so noise hardly changes it


def planner_of(
    model: DynamicsModel,
    horizon: int,
    seed: int = 0,
    set_points: Mapping[str, float] | None = None,
    limits: Sequence[Limit] = (),
    sensor_noise: Mapping[str, float] | None = None,
) -> Planner:
    """Return a planner on a model, after value iteration on a grid, which takes some seconds.

    Args:
        model: the model.
        horizon: number of steps of each rollout.
        seed: seed of the changes of actions that the planner tries.
        set_points: values of coordinates, in the place of those that the declared reward measures errors from.
        limits: limits that the planner keeps besides those of the specification.
        sensor_noise: standard deviations of measurements, by coordinate. The planner then filters what it measures.

    Raises:
        InvalidInput: the horizon is out of its range, the reward or the model does not support a set point, the model
            does not move a coordinate with sensor noise, or the model or its environment does not allow planning.
    """
    if type(horizon) is not int or not 1 <= horizon <= MOST_HORIZON:
        raise InvalidInput(f"horizon: expected a whole number of steps from 1 to {MOST_HORIZON}, got {horizon!r}")
    model = with_set_points(model, tuple((set_points or {}).items()))
    inverse, able, steps = _requirements(model)
    pending = PendingActions.of(steps)
    _, able, fewer = _requirements(able.for_planning())
    policy = solve(replace(pending, steps=fewer), model.terminal_reward, model.definition.time_limit, limits)
    noise = {name: std for name, std in (sensor_noise or {}).items() if std > 0}
    state_filter = StateFilter.of(model, steps, noise) if noise else None
    return Planner(model.definition, inverse, able, policy, horizon, seed, pending, state_filter)


def allows_planning(model: DynamicsModel) -> bool:
    """Return whether ``planner_of`` can plan on a model."""
    try:
        _requirements(model)
    except InvalidInput:
        return False
    return True


def _requirements(model: DynamicsModel) -> tuple[ObservationInverse, PlannedActions, ArraySteps]:
    """Return what a planner needs of a model. Raises ``InvalidInput`` with the reason if it does not allow planning."""
    inverse = _inverse(model.definition)
    able, compiled = offers(model, PlannedActions), offers(model, CompiledSteps)
    steps = None if compiled is None else compiled.compiled()
    if able is None or steps is None or not able.plans:
        raise InvalidInput(
            "expected a model of Gaussian processes with compiled steps, beside at most one prior, because a planner "
            "rolls it out in compiled code: train a network (--algorithm fastppo)"
        )
    return inverse, able, steps


def _inverse(definition: EnvironmentDefinition) -> ObservationInverse:
    """Return the function that computes coordinates from observations, or raise ``InvalidInput`` with the reason why
    the environment does not allow planning."""
    action, names = definition.action, [c.name for c in definition.coordinates]
    lacking = unfit(definition)
    asked: dict[str, bool] = {
        lacking or "": lacking is None,
        "an action without bins": not (isinstance(action, BoxAction) and action.bins),
        "an action without rate": not definition.rates,
        "no reward outside of the log's states": definition.outside_reward is None,
    }
    for expected, holds in asked.items():
        if not holds:
            raise InvalidInput(f"a planner needs {expected}: train a network (--algorithm fastppo)")
    inverse = ObservationInverse.of(definition, lags=True)
    found = {index for index, _ in inverse.sources}
    missing = [name for i, name in enumerate(names) if i not in found]
    if missing:
        raise InvalidInput(
            f"a planner reads the state from the observation, and {', '.join(missing)} can't be computed from it: "
            "train a network (--algorithm fastppo)"
        )
    return inverse


@dataclass(eq=False)
class Planner:
    """A policy: a function from observations (N, D) to actions, (N, F), or (N,) if they are discrete.

    It keeps the plans of its last call. A plan is continued from the state that it predicted; elsewhere the search
    begins anew. So episodes need no names, and a planner may serve several at once.

    It also keeps an estimate of the lasting error of the predicted change of each coordinate, and adds it to the steps
    of the rollouts. If sensors are noisy, a Kalman filter estimates the state from the measurements since the plan
    began. If actions take effect after a dead time, a plan begins at the state that is predicted for then.
    """

    definition: EnvironmentDefinition
    inverse: ObservationInverse
    model: PlannedActions
    policy: GridPolicy
    horizon: int
    seed: int
    pending: PendingActions
    state_filter: StateFilter | None = None
    _calls: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        low, high = (ends.cpu().numpy() for ends in self.definition.sampled)
        self._span = high - low
        self._cyclic = np.array([c.kind == "angle" for c in self.definition.coordinates])
        self._changes = _changes(self.policy, self.horizon, self.seed)
        # A measurement this far from the predicted state, or nearer, continues a plan, (C,).
        self._near = NEAR * self._span + (0.0 if self.state_filter is None else self.state_filter.errors)
        self._last = Decisions.none(len(low), self.horizon, len(self.policy.least))

    def __call__(self, observations: NDArray[np.floating[Any]]) -> NDArray[Any]:
        actions = self.from_states(self.states(observations))
        return actions[:, 0].astype(np.int64) if self.policy.choices else actions

    def states(self, observations: NDArray[np.floating[Any]]) -> Floats:
        """Return the states (N, C) that observations (N, D) show."""
        shown = torch.from_numpy(np.asarray(observations, dtype=np.float64))
        return self.inverse(shown, shown.new_zeros(len(shown), len(self._span))).numpy()

    def from_states(self, q: Floats) -> Floats:
        """Return the actions (N, F) for states q (N, C). A discrete action is given by its number."""
        now, pending = self._continued(q), self.pending
        actions = np.empty((len(q), now.plans.shape[2]))
        changes, starts = self._changes[self._calls % SETS], pending.forecast(now.states, now.offsets)

        def plan(rows: slice) -> None:
            for i in range(len(q))[rows]:
                actions[i], now.arrived[i] = self.model.planned(
                    self.policy, starts[i], now.offsets[i], pending.early, pending.late, changes, ELITE, now.plans[i]
                )

        side_by_side(plan, len(q), STATES, torch.get_num_threads())
        if pending.dead:
            now.arrived = pending.after(now.states, actions, now.offsets)
        if self.state_filter is not None:
            now.covariances = self.state_filter.predicted(now.states, now.covariances, actions)
        self._calls += 1
        self._last = now
        return actions

    def _continued(self, q: Floats) -> Decisions:
        """Return what is known before the decisions at measured states q (N, C): the plans to continue, and the
        estimated errors of the predicted changes. They are those of the call before for the same row, or else for the
        row whose predicted state is nearest. If no predicted state is near, return the policy's plan and 0."""
        last, count = self._last, len(q)
        now = Decisions.none(len(self._span), self.horizon, len(self.policy.least), count)
        now.states, rows = q.copy(), np.full(count, -1)
        now.plans[:] = -1.0 if self.policy.choices else 0.0
        for i in range(count if len(last.states) else 0):
            share = (np.abs(apart(q[i], last.arrived, self._cyclic)) / self._near).max(1)
            row = i if i < len(share) and share[i] <= 1 else int(np.argmin(share))
            if share[row] <= 1:
                rows[i] = row
        some = np.flatnonzero(rows >= 0)
        before = rows[some]
        if self.state_filter is not None:
            now.covariances[:] = self.state_filter.measured
            now.states[some], now.covariances[some] = self.state_filter.corrected(
                q[some], last.arrived[before], last.covariances[before]
            )
        now.plans[some, :-1] = last.plans[before, 1:]
        moved = np.abs(apart(now.states[some], last.states[before], self._cyclic)) / self._span
        still = moved.max(1, keepdims=True) <= STILL
        error = apart(q[some], last.arrived[before], self._cyclic)
        now.offsets[some] = last.offsets[before] + np.where(still, GAIN * error, 0.0)
        return now


@dataclass(eq=False)
class Decisions:
    """What a planner keeps of a call with N states."""

    states: Floats  # (N, C) measured or estimated states
    arrived: Floats  # (N, C) predicted states after the first action
    covariances: Floats  # (N, C, C) covariances of the estimated states; later those of the predicted ones
    plans: Floats  # (N, T, F)
    offsets: Floats  # (N, C) estimated lasting errors of the predicted changes

    @classmethod
    def none(cls, coordinates: int, horizon: int, entries: int, count: int = 0) -> Decisions:
        """Return plans, states and errors of 0 for ``count`` states."""
        shape = (count, coordinates)
        return cls(
            np.zeros(shape),
            np.zeros(shape),
            np.zeros((*shape, coordinates)),
            np.zeros((count, horizon, entries)),
            np.zeros(shape),
        )


def _changes(policy: GridPolicy, horizon: int, seed: int) -> Floats:
    """Return the sets of changes (SETS, R, N, T, F) that decisions try."""
    rng, shape = np.random.default_rng(seed), (SETS, ROUNDS, ROLLOUTS, horizon, len(policy.least))
    if not policy.choices:
        noise = rng.standard_normal(shape)
        for t in range(1, horizon):
            noise[..., t, :] = COLOUR * noise[..., t - 1, :] + np.sqrt(1 - COLOUR**2) * noise[..., t, :]
        narrow = NARROWING ** np.arange(ROUNDS)[:, None, None, None]
        changes: Floats = noise * narrow * SPREAD * (policy.most - policy.least) / 2
        changes[:, :, 0] = 0.0
        return changes
    changes = np.where(rng.random(shape[:3]) < 0.5, -1.0, -2.0)[..., None, None] * np.ones(shape[3:])
    for chosen in changes.reshape(-1, *shape[3:]):
        begin = int(rng.choice(BEGINNINGS))
        chosen[begin : begin + int(rng.choice(LENGTHS))] = rng.integers(policy.choices)
    for a in range(min(policy.choices, ROLLOUTS - 2)):
        changes[:, 0, 2 + a] = -1.0
        changes[:, 0, 2 + a, 0] = a
    return changes
