"""Reset and step of N lanes, with autoreset in Gymnasium's three modes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput, NotReset
from surrogym_server.models.abilities import ArraySteps
from surrogym_server.models.port import DynamicsModel
from surrogym_server.tensors import GPU_BLOCK, fetched, sent
from surrogym_server.virtual.dynamics import Moved, move_mean, move_particles
from surrogym_server.virtual.lanes import ENDED, EVERY, NEW, RUNNING, Chosen, LaneState
from surrogym_server.virtual.noise import Purpose, normal_noise
from surrogym_server.virtual.paths import with_paths
from surrogym_server.virtual.residual import Residual, with_residual
from surrogym_server.virtual.sensors import SensorNoise, driving, sensed
from surrogym_server.virtual.start import start_coordinates, start_particles
from surrogym_shared.kinds import AutoresetMode, Variant

Floats = NDArray[np.floating[Any]]
Bools = NDArray[np.bool_]
Ints = NDArray[np.integer[Any]]
# What a step takes for a while, as measured on a CPU: bytes for each coordinate of a lane or particle, and arrays as
# large as the weights of the lanes' sampled functions.
STEP_BYTES, STEP_PATHS = 400, 5


@dataclass(frozen=True)
class VirtualSettings:
    """Options of a session of virtual environments (lanes). They are fixed when the session is opened."""

    num_envs: int
    variant: Variant = "deterministic"
    autoreset_mode: AutoresetMode = "next_step"
    time_limit: int | None = None
    # Each reward is reduced by this multiple of its predicted standard deviation (k of eq. 14).
    penalty: float = 0.0
    start_box: float = 0.0  # share of the episodes that start at a random state of the sampling range
    start_visited: float = 0.0  # share of the episodes that start at a state of a real step, see ``visited``
    particles: int = 1_000
    spread: float = 0.01  # standard deviation of the particles at the start, as a share of each coordinate's range
    # In variant pathwise, episodes follow functions sampled from the posterior. This is the number of functions that
    # the lanes share. If it is None, each episode follows a function of its own.
    functions: int | None = None
    residual: Residual | None = None  # systematic errors that are added to each prediction; None adds nothing
    process_noise: bool = False  # whether random noise of the learned size (w of eq. 2) is added to each next state
    set_points: tuple[tuple[str, float], ...] = ()  # other set points of the declared reward, by coordinate
    sensor_noise: SensorNoise = ()  # measurement noise added to observed coordinates; it does not change the state
    reward_limits: tuple[float, float] | None = None  # mean rewards are limited to this range; None: no limits
    # An episode is truncated if the predicted standard deviation of any output exceeds this multiple of the output's
    # standard deviation over the samples. None: no episode is truncated for this reason.
    trust: float | None = None
    compiled: bool = False  # whether steps use the model's compiled code; decided when the session opens
    # (k, C) the coordinates of k real steps; the share ``start_visited`` of the episodes starts at one of these states.
    visited: Tensor | None = field(default=None, compare=False, repr=False)

    @property
    def doubts(self) -> bool:
        """Whether steps need the standard deviations of all outputs, because ``trust`` is used."""
        return self.trust is not None


@dataclass(frozen=True)
class LaneTransition:
    """Results of one step of N lanes (parallel environments), as NumPy arrays. Lanes that are not stepped have reward
    0, and all their flags are false."""

    observation: Floats  # (N, D) float32, observation of each lane; if the lane was reset, that of the new episode
    reward: Floats  # (N,) reward less the penalties for uncertainty
    terminated: Bools  # (N,) lanes whose episode ended in a terminal state
    truncated: Bools  # (N,) lanes whose episode ended by the time limit, or because the model is too uncertain there
    # (K,) indices of the K lanes whose episode ended and that were reset in the same step. K is 0 except in autoreset
    # mode same_step.
    final_lanes: Ints
    final_observation: Floats  # (K, D) float32, last observation of the ended episode of each lane in ``final_lanes``
    reset_lanes: Bools  # (N,) lanes in which a new episode began
    reward_mean: Floats  # (N,) reward without the penalties for uncertainty
    std: Floats | None  # (N, O) predicted standard deviation of each of the O outputs; None if not requested
    # (N,) lanes that were truncated because a predicted standard deviation exceeded the limit ``trust``; None if
    # ``trust`` is None.
    untrusted: Bools | None
    # (N,) lanes whose episode ended early: outside the sampling range, or where the model is too uncertain, if a reward
    # outside is declared; or where the fallback of declared limits acts. None if neither that reward nor limits are
    # declared.
    left: Bools | None = None


def expected_bytes(definition: EnvironmentDefinition, settings: VirtualSettings, path_size: int) -> int:
    """Return the approximate memory in bytes that the lanes of a session need: for coordinates, for particles (variant
    probabilistic), and for sampled functions of ``path_size`` weights, one for each lane (variant pathwise)."""
    particles = settings.particles if settings.variant == "probabilistic" else 0
    path = path_size if settings.variant == "pathwise" else 0
    return 8 * settings.num_envs * (len(definition.coordinates) * (1 + particles) + path)


def expected_gpu_bytes(
    definition: EnvironmentDefinition, settings: VirtualSettings, path_size: int, samples: int
) -> int:
    """Return the approximate memory in bytes that a session of a model of ``samples`` samples takes on a GPU in a step:
    its lanes before and after the step, what the step computes for each of them, and a block of covariances."""
    rows = settings.num_envs * (settings.particles if settings.variant == "probabilistic" else 1)
    path = path_size if settings.variant == "pathwise" else 0
    covariances = min(GPU_BLOCK, rows * samples * len(definition.outputs))
    each = rows * len(definition.coordinates) * STEP_BYTES + 8 * settings.num_envs * path * STEP_PATHS
    return 2 * expected_bytes(definition, settings, path_size) + each + 16 * covariances


def create(definition: EnvironmentDefinition, settings: VirtualSettings, seed: int) -> LaneState:
    """Create the state of N lanes that have not been reset yet. ``seed`` determines all their random numbers."""
    count, size = settings.num_envs, len(definition.coordinates)
    particles = settings.particles if settings.variant == "probabilistic" else 0
    none = torch.zeros(count, 0, dtype=torch.float64, device=definition.device)
    return LaneState(
        seed=np.full(count, seed),
        lane=np.arange(count),
        episode=np.full(count, -1),
        elapsed=np.zeros(count, dtype=np.int64),
        phase=np.full(count, NEW, dtype=np.int8),
        q=none.new_zeros(count, size),
        particles=none.new_zeros(count, particles, size),
        path=none,
    )


def reset(
    definition: EnvironmentDefinition,
    settings: VirtualSettings,
    lanes: LaneState,
    seed: int | Sequence[int] | None = None,
    mask: Bools | None = None,
) -> tuple[LaneState, Floats]:
    """Begin new episodes in all lanes, or in those of the mask (N,). Return the lanes and their observations (N, D).

    The random numbers of a lane depend on a key. With an integer seed s, lane i gets the key (s, i); with a list of
    seeds it gets (s_i, 0). In both cases it begins episode 0. Without a seed each lane keeps its key and begins its
    next episode. Lanes outside the mask keep their state.

    Raises:
        InvalidInput: the mask or the list of seeds has a wrong length, or a seed is negative or too large.
    """
    chosen = chosen_lanes(mask, lanes)
    if seed is not None:
        lanes = _seeded(lanes, seed, chosen)
    lanes = _begin(definition, settings, lanes, chosen)
    (observation,) = fetched(_observe(definition, settings, lanes))
    return lanes, observation


@torch.inference_mode()  # autograd records nothing, which makes a step a sixth faster
def step(
    model: DynamicsModel,
    settings: VirtualSettings,
    lanes: LaneState,
    u: Floats,
    mask: Bools | None = None,
    stds: bool = False,
    particle_steps: ArraySteps | None = None,
) -> tuple[LaneState, LaneTransition]:
    """Step all N lanes (parallel environments), or those that ``mask`` (N,) selects, under actions u (N, F), in torch.
    This is the reference implementation of ``virtual.step``, with the same arguments and errors.

    On a device the program waits for a step once, when it fetches the results; and once more if autoreset in mode
    same_step then begins episodes. A boolean mask, a number or a list that would go to or from the device before that
    would make it wait too.

    If ``particle_steps`` are given, they predict the steps of particles in compiled code.
    """
    definition = model.definition
    moving, beginning = divided(settings, lanes, chosen_lanes(mask, lanes))
    active = lanes.take(moving)
    if settings.variant == "pathwise":
        active = with_paths(model, active, settings.functions)
    action = definition.within_rates(active.q, sent(u[moving], definition.device))
    moved = _move(model, settings, active, action, stds, particle_steps)
    if settings.residual is not None:
        moved = with_residual(model, settings.residual, active, action, moved)
    untrusted = _untrusted(model, settings, moved)
    left = _left(definition, active.q, moved, untrusted)
    if left is not None:
        moved = _paid_outside(definition, settings, active, moved, left)
    active = replace(active, elapsed=active.elapsed + 1, q=moved.q, particles=moved.particles)
    after = lanes.put(moving, active)
    if beginning is not None:
        after = _begin(definition, settings, after, beginning)
    observation, reward, reward_mean, std, over, doubtful, early = fetched(
        _observe(definition, settings, after),
        moved.reward,
        None if moved.reward is moved.reward_mean else moved.reward_mean,
        moved.std if stds else None,
        moved.terminated,
        untrusted,
        left,
    )
    cut = _cut(settings, active, doubtful)
    after = replace(after, phase=after.phase.copy())
    after.phase[moving] = np.where(over | cut, ENDED, RUNNING)
    terminated, truncated = (scattered(moving, len(lanes), flags) for flags in (over, cut))
    final_lanes = np.zeros(0, dtype=np.int64)
    if settings.autoreset_mode == "same_step":
        beginning = terminated | truncated
        final_lanes = beginning.nonzero()[0]
    final_observation = observation[final_lanes]
    if len(final_lanes):
        after = _begin(definition, settings, after, final_lanes)
        (observation[final_lanes],) = fetched(_observe(definition, settings, after.bare.take(final_lanes)))
    reward = scattered(moving, len(lanes), reward)
    return after, LaneTransition(
        observation=observation,
        reward=reward,
        terminated=terminated,
        truncated=truncated,
        final_lanes=final_lanes,
        final_observation=final_observation,
        reset_lanes=np.zeros(len(lanes), dtype=bool) if beginning is None else beginning,
        reward_mean=reward.copy() if reward_mean is None else scattered(moving, len(lanes), reward_mean),
        std=None if std is None else scattered(moving, len(lanes), std),
        untrusted=None if doubtful is None else scattered(moving, len(lanes), doubtful),
        left=None if early is None else scattered(moving, len(lanes), early),
    )


def divided(settings: VirtualSettings, lanes: LaneState, chosen: Bools | slice) -> tuple[Bools | slice, Bools | None]:
    """Divide the chosen lanes (parallel environments) into those that this step moves and those that it resets.

    Returns:
        The lanes to move, and a mask (N,) of the lanes to reset because their episode has ended, or None if there are
        none.

    Raises:
        NotReset: a chosen lane has no running episode, and autoreset does not start one in this step.
    """
    running = lanes.phase == RUNNING
    if running.all():
        return chosen, None
    if isinstance(chosen, slice):
        chosen = np.ones_like(running)
    waiting = chosen & (lanes.phase == ENDED)
    refused = chosen & ~running
    if settings.autoreset_mode == "next_step":
        refused = refused & ~waiting
    if refused.any():
        which = refused.nonzero()[0].tolist()
        shown = f"{which[:8]}{' and more' if len(which) > 8 else ''}"
        raise NotReset(f"lanes {shown} have no running episode; reset these lanes before you step them")
    return chosen & ~waiting, waiting


def _move(
    model: DynamicsModel,
    settings: VirtualSettings,
    lanes: LaneState,
    u: Tensor,
    stds: bool,
    particle_steps: ArraySteps | None,
) -> Moved:
    outputs, particles = len(model.definition.outputs) - 1, lanes.particles.shape[1]
    process = None
    if settings.process_noise:
        process = normal_noise(lanes, Purpose.PROCESS, max(particles, 1), outputs)
        process = driving(model, settings.sensor_noise, process)
    if settings.variant == "probabilistic":
        noise = normal_noise(lanes, Purpose.TRANSITION, particles, outputs)
        return move_particles(
            model,
            lanes.particles,
            u,
            settings.penalty,
            noise,
            process=process,
            steps=particle_steps,
        )
    return move_mean(
        model,
        lanes.q,
        u,
        settings.penalty,
        stds or settings.doubts,
        process=None if process is None else process[:, 0],
        paths=lanes.path if settings.variant == "pathwise" else None,
        functions=settings.functions,
    )


def _untrusted(model: DynamicsModel, settings: VirtualSettings, moved: Moved) -> Tensor | None:
    """Return in which of N lanes the model is too uncertain, (N,) bool: the predicted standard deviation of any output
    is above ``trust`` times the output's standard deviation over the samples. Return None if ``trust`` is None."""
    if settings.trust is None:
        return None
    assert moved.std is not None
    return (moved.std > settings.trust * model.scales).any(1)


def _left(definition: EnvironmentDefinition, q: Tensor, moved: Moved, untrusted: Tensor | None) -> Tensor | None:
    """Return (N,) bool: which of N lanes end early after a step from q (N, C).

    If the specification declares an outside reward (for each step that an episode then misses), a lane ends early if
    its next state lies outside the sampling range or if it is in ``untrusted`` (N,). If limits are declared, it ends
    early if their fallback action would take over. Return None if neither is declared.
    """
    if definition.outside_reward is None and definition.limits is None:
        return None
    left = definition.falls_back(q, moved.q)
    if definition.outside_reward is not None:
        left = left | ~definition.in_range(moved.q)
        left = left if untrusted is None else left | untrusted
    return left & ~moved.terminated


def paid_outside(definition: EnvironmentDefinition, settings: VirtualSettings) -> float:
    """Return the reward for each step that an episode misses because it ended early, outside the sampling range or at a
    limit. This is the declared outside reward; if none is declared, the lowest mean reward of a step
    (``reward_limits``); if that is None, 0."""
    if definition.outside_reward is not None:
        return definition.outside_reward
    return 0.0 if settings.reward_limits is None else settings.reward_limits[0]


def _paid_outside(
    definition: EnvironmentDefinition, settings: VirtualSettings, before: LaneState, moved: Moved, left: Tensor
) -> Moved:
    """Terminate the lanes that the mask ``left`` (N,) selects, and replace their rewards by the outside reward.

    The outside reward is paid once for this step and once for each further step up to the time limit. Without a time
    limit it is paid for this step only.
    """
    lacking = torch.ones_like(moved.reward)
    if settings.time_limit is not None:
        lacking = sent((settings.time_limit - before.elapsed).clip(min=1).astype(np.float64), definition.device)
    lost = paid_outside(definition, settings) * lacking
    mean = torch.where(left, lost, moved.reward_mean)
    reward = mean if moved.reward is moved.reward_mean else torch.where(left, lost, moved.reward)
    return replace(moved, reward_mean=mean, reward=reward, terminated=moved.terminated | left)


def _cut(settings: VirtualSettings, after: LaneState, untrusted: Bools | None) -> Bools:
    """Return a mask (N,) of the lanes that are truncated after their step: by the time limit, or because they are in
    ``untrusted`` (N,). As in Gymnasium, a step may both terminate and truncate."""
    cut = np.zeros(len(after), dtype=bool) if settings.time_limit is None else after.elapsed >= settings.time_limit
    return cut if untrusted is None else cut | untrusted


def _begin(definition: EnvironmentDefinition, settings: VirtualSettings, lanes: LaneState, chosen: Chosen) -> LaneState:
    """Begin new episodes in the lanes that ``chosen``, a mask or indices, selects."""
    fresh = lanes.bare.take(chosen)
    if not len(fresh):
        return lanes
    begun = np.full_like(fresh.phase, RUNNING)
    fresh = replace(fresh, episode=fresh.episode + 1, elapsed=np.zeros_like(fresh.elapsed), phase=begun)
    q = start_coordinates(definition, fresh, settings.start_box, settings.start_visited, settings.visited)
    particles = fresh.particles
    if settings.variant == "probabilistic":
        particles = start_particles(definition, fresh, q, settings.particles, settings.spread)
    return lanes.put(chosen, replace(fresh, q=q, particles=particles))


def _seeded(lanes: LaneState, seed: int | Sequence[int], chosen: Bools | slice) -> LaneState:
    outside = [s for s in ([seed] if isinstance(seed, int) else seed) if not 0 <= s < 2**63]
    if outside:
        raise InvalidInput(f"seed: expected a whole number from 0 to 2^63 - 1, got {outside[0]}")
    if isinstance(seed, int):
        seeds, numbers = np.full_like(lanes.seed, seed), np.arange(len(lanes))
    else:
        if len(seed) != len(lanes):
            raise InvalidInput(
                f"seed: expected a whole number, or {len(lanes)} of them, one for each lane, got a list of {len(seed)}"
            )
        seeds, numbers = np.array(seed, dtype=np.int64), np.zeros_like(lanes.lane)
    replaced = np.ones(len(lanes), dtype=bool) if isinstance(chosen, slice) else chosen
    return replace(
        lanes,
        seed=np.where(replaced, seeds, lanes.seed),
        lane=np.where(replaced, numbers, lanes.lane),
        episode=np.where(replaced, -1, lanes.episode),
    )


def _observe(definition: EnvironmentDefinition, settings: VirtualSettings, lanes: LaneState) -> Tensor:
    return definition.observe(sensed(definition, settings.sensor_noise, lanes)).to(torch.float32)


def chosen_lanes(mask: Bools | None, lanes: LaneState) -> Bools | slice:
    """Return a mask (N,) of lanes as a selection of these lanes; a mask of None selects all lanes. Raises
    ``InvalidInput`` for a mask of another length."""
    if mask is None:
        return EVERY
    if len(mask) != len(lanes):
        raise InvalidInput(f"mask: expected {len(lanes)} entries, one for each lane, got {len(mask)}")
    return np.array(mask, dtype=bool)  # a copy, because that of a message is read-only, which compiled code refuses


def scattered(chosen: Chosen, count: int, values: NDArray[Any]) -> NDArray[Any]:
    """Return an array with ``count`` rows, one for each lane: the rows of ``values``, in order, in the ``chosen``
    lanes, and zeros in all others."""
    if isinstance(chosen, slice):
        return values
    full = np.zeros((count, *values.shape[1:]), dtype=values.dtype)
    full[chosen] = values
    return full
