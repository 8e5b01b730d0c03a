"""Step of N lanes (parallel environments) in compiled code. The reference implementation is ``environment.step``.

The NumPy arrays share memory with the tensors of the lanes' state. A step copies each array before it changes it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_server.compiled.tables import Tables
from surrogym_server.environment.compiled.terms import tables_of
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.models.abilities import ArraySteps, ArrayTransition
from surrogym_server.models.port import DynamicsModel
from surrogym_server.virtual.compiled.outcome import conclude, observe
from surrogym_server.virtual.environment import (
    LaneTransition,
    VirtualSettings,
    chosen_lanes,
    divided,
    paid_outside,
    scattered,
)
from surrogym_server.virtual.lanes import RUNNING, LaneState
from surrogym_server.virtual.noise import Purpose, normal_noise
from surrogym_server.virtual.paths import with_paths
from surrogym_server.virtual.sensors import driving, sensed
from surrogym_server.virtual.start import start_coordinates

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

MODELS = 64  # number of models whose tables of observation terms stay in a cache
ANYWHERE = np.zeros((0, 0))  # passed as the sampling range if leaving this range does not end an episode
NO_LANES = np.zeros(0, dtype=np.int64)
NO_FALLBACK = np.zeros(0, dtype=np.bool_)  # passed if the environment declares no limits and so no fallback action


@dataclass(frozen=True)
class _Changed:
    """Arrays of one step of N lanes (parallel environments): copies of the parts of the lanes' state that the step
    changes in place, and the arrays of its results."""

    q: Floats  # (N, C) coordinates of each lane's state
    episode: Ints  # (N,) number of each lane's current episode: 0, 1, ...
    elapsed: Ints  # (N,) number of steps that each lane's episode has taken
    phase: NDArray[np.int8]  # (N,) phase of each lane: NEW, RUNNING or ENDED
    rewards: Floats  # (2, N) rewards less the penalties for uncertainty, and rewards without them
    # (5, N) five flags of each lane. The episode: terminated; was truncated; was truncated because the model is too
    # uncertain; terminated or was truncated; ended early, as a declared outside reward or limits require.
    ends: Bools

    @classmethod
    def of(cls, lanes: LaneState) -> _Changed:
        q, count = lanes.q.numpy().copy(), len(lanes)
        counts = lanes.episode.copy(), lanes.elapsed.copy(), lanes.phase.copy()
        return cls(q, *counts, np.empty((2, count)), np.empty((5, count), dtype=np.bool_))

    def lanes(self, before: LaneState) -> LaneState:
        q, particles, path = torch.from_numpy(self.q), before.particles, before.path
        return LaneState(before.seed, before.lane, self.episode, self.elapsed, self.phase, q, particles, path)


def compiled_step(
    model: DynamicsModel,
    move: ArraySteps,
    settings: VirtualSettings,
    lanes: LaneState,
    u: NDArray[np.floating[Any]],
    mask: Bools | None,
    stds: bool,
) -> tuple[LaneState, LaneTransition]:
    """Step all N lanes (parallel environments), or those that ``mask`` (N,) selects, under actions u (N, F), in
    compiled code. Except for rounding errors, the results equal those of ``virtual.environment.step``.

    ``move`` is the model's compiled step.
    """
    definition, changed = model.definition, _Changed.of(lanes)
    moving, beginning = divided(settings, lanes, chosen_lanes(mask, lanes))
    running = np.ones(len(lanes), dtype=np.bool_) if isinstance(moving, slice) else moving
    if settings.variant == "pathwise":
        lanes = lanes.put(moving, with_paths(model, lanes.take(moving), settings.functions))
    moved = _moved(model, move, settings, lanes, u, moving, stds)
    ended = _concluded(model, settings, running, moved, changed, _fallen(definition, moving, lanes, moved))
    final_lanes = NO_LANES
    if settings.autoreset_mode == "same_step":
        beginning = changed.ends[3]
        final_lanes = beginning.nonzero()[0] if ended else NO_LANES
    final_observation = _observed(
        move, _shown(definition, settings, lanes, changed, final_lanes if ended else NO_LANES)
    )
    if beginning is not None and (ended or settings.autoreset_mode != "same_step"):
        _begin(definition, settings, lanes, beginning, changed)
    return changed.lanes(lanes), LaneTransition(
        observation=_observed(move, _shown(definition, settings, lanes, changed)),
        reward=changed.rewards[0],
        terminated=changed.ends[0],
        truncated=changed.ends[1],
        final_lanes=final_lanes,
        final_observation=final_observation,
        reset_lanes=np.zeros(len(changed.phase), dtype=bool) if beginning is None else beginning,
        reward_mean=changed.rewards[1],
        std=scattered(moving, len(lanes), moved.std) if stds else None,
        untrusted=None if settings.trust is None else changed.ends[2],
        left=None if definition.outside_reward is None and definition.limits is None else changed.ends[4],
    )


def _moved(
    model: DynamicsModel,
    move: ArraySteps,
    settings: VirtualSettings,
    lanes: LaneState,
    u: NDArray[np.floating[Any]],
    moving: Bools | slice,
    stds: bool,
) -> ArrayTransition:
    """Predict one step of the lanes (parallel environments) that ``moving`` selects, under actions u (N, F). The result
    has one row for each selected lane, in order."""
    wanted, process = stds or settings.doubts, None
    if settings.process_noise:
        drawn = normal_noise(lanes, Purpose.PROCESS, 1, len(model.definition.outputs) - 1)[:, 0]
        process = driving(model, settings.sensor_noise, drawn).numpy()
    return move(
        _rows(moving, lanes.q.numpy()),
        _rows(moving, u),
        noise=None,
        process=None if process is None else _rows(moving, process),
        paths=_rows(moving, lanes.path.numpy()) if settings.variant == "pathwise" else None,
        stds=wanted,
        reward_std=wanted or settings.penalty > 0,
    )


def _rows(moving: Bools | slice, values: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(values if isinstance(moving, slice) else values[moving])


def _fallen(
    definition: EnvironmentDefinition, moving: Bools | slice, lanes: LaneState, moved: ArrayTransition
) -> Bools:
    """Return for each of the K lanes that ``moving`` selects whether the fallback action of the declared limits would
    take over after the step, (K,) bool. Without limits, return an empty array."""
    if definition.limits is None:
        return NO_FALLBACK
    fallen: Bools = definition.falls_back(lanes.take(moving).q, torch.from_numpy(moved.q_next)).numpy()
    return fallen


def _concluded(
    model: DynamicsModel,
    settings: VirtualSettings,
    moving: Bools,
    moved: ArrayTransition,
    changed: _Changed,
    fallen: Bools,
) -> int:
    """Complete a step from the predictions ``moved``: write states, rewards and ends of episodes of the lanes that the
    mask ``moving`` (N,) selects to ``changed``. Return the number of lanes whose episode ended. ``fallen`` has a flag
    for each selected lane: whether the fallback action of the declared limits would take over."""
    trust, limit, outside = settings.trust, settings.time_limit, model.definition.outside_reward
    scales = model.scales.numpy() if settings.doubts else np.zeros(0)
    return conclude(
        moving,
        moved.q_next,
        moved.reward,
        moved.std,
        moved.terminated,
        fallen,
        scales,
        model.terminal_reward,
        settings.penalty,
        np.inf if trust is None else trust,
        -1 if limit is None else limit,
        ANYWHERE if outside is None else torch.stack(model.definition.sampled).numpy(),
        paid_outside(model.definition, settings),
        changed.q,
        changed.elapsed,
        changed.phase,
        changed.rewards,
        changed.ends,
    )


def _begin(
    definition: EnvironmentDefinition, settings: VirtualSettings, lanes: LaneState, chosen: Bools, changed: _Changed
) -> None:
    """Begin new episodes in the lanes that the mask ``chosen`` (N,) selects: write their states to ``changed``."""
    fresh = lanes.take(chosen)
    fresh = replace(fresh, episode=fresh.episode + 1, elapsed=np.zeros_like(fresh.elapsed))
    starts = settings.start_box, settings.start_visited, settings.visited
    changed.q[chosen] = start_coordinates(definition, fresh, *starts).numpy()
    changed.episode[chosen] += 1
    changed.elapsed[chosen] = 0
    changed.phase[chosen] = RUNNING


def _shown(
    definition: EnvironmentDefinition,
    settings: VirtualSettings,
    before: LaneState,
    changed: _Changed,
    chosen: Ints | None = None,
) -> Floats:
    """Return the states (n, C) of the n lanes whose indices are ``chosen``, or of all lanes, as sensors show them: with
    the measurement errors of the setting ``sensor_noise``. The step changed the lanes' state ``before`` to
    ``changed``."""
    if not settings.sensor_noise or (chosen is not None and not len(chosen)):
        return changed.q if chosen is None else changed.q[chosen]
    lanes = changed.lanes(before)
    lanes = lanes if chosen is None else lanes.take(chosen)
    shown: Floats = sensed(definition, settings.sensor_noise, lanes).numpy()
    return shown


def _observed(steps: ArraySteps, q: Floats) -> Singles:
    observation = np.empty((len(q), len(steps.definition.observation_names)), dtype=np.float32)
    if len(q):
        observe(*_observation_tables(steps), q, observation)
    return observation


@lru_cache(maxsize=MODELS)
def _observation_tables(steps: ArraySteps) -> Tables:
    return tables_of(steps.definition.observe)
