"""Prediction of one step: to the mean next state (AUR-D in the paper), along a sampled function, or by particles (AUR-P
in the paper, section 4)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.step_rules import paid
from surrogym_server.models.abilities import ArraySteps
from surrogym_server.models.draws import function_draws
from surrogym_server.models.guard import require_shapes
from surrogym_server.models.port import DynamicsModel, Transition

# Particles are weighted by 1 / (variance of the particle's reward). This share of the reward's variance over the
# samples is added to each variance, so that no weight is infinite.
WEIGHT_FLOOR = 1e-12
# Smaller variances of a particle's reward, such as 0, are raised to this one, because the weights divide by them.
LEAST_VARIANCE = 1e-290


@dataclass(frozen=True)
class Moved:
    """Prediction of one step of N lanes (parallel environments)."""

    q: Tensor  # (N, C) coordinates of each lane after the step
    particles: Tensor  # (N, P, C) coordinates of each lane's P particles after the step; P is 0 in variants without any
    reward_mean: Tensor  # (N,) reward of each lane, without the penalty for uncertainty
    reward: Tensor  # (N,) reward of each lane, less the penalty for uncertainty (eq. 14)
    terminated: Tensor  # (N,) bool: whether the step reached a terminal state
    std: Tensor | None  # (N, O) predicted standard deviation of each of the O outputs; None if no caller needs it


def move_mean(
    model: DynamicsModel,
    q: Tensor,
    u: Tensor,
    penalty: float,
    stds: bool,
    *,
    process: Tensor | None = None,
    paths: Tensor | None = None,
    functions: int | None = None,
) -> Moved:
    """Predict one step of N lanes from q (N, C) under u (N, F): to the mean next state (variant AUR-D of the paper), or
    with ``paths`` along a sampled function of each lane.

    Args:
        model: the model.
        q: states before the step.
        u: actions.
        penalty: number of standard deviations to subtract from the reward (eq. 14).
        stds: whether the standard deviations of the outputs are needed.
        process: (N, M) standard normal numbers, by which the learned noise moves the next state, or None for no noise.
        paths: (N, W) weights of the sampled function that each lane follows, or None for the mean.
        functions: number of functions that the lanes share, or None if each lane has its own.
    """
    step = model.transition if paths is None else partial(function_draws(model, functions).transition_along, paths)
    transition = step(q, u, process=process, stds=stds, reward_std=stds or penalty > 0)
    require_shapes(model, transition, q)
    over, spread = model.terminated(transition.q_next), transition.reward_std
    mean = paid(model.terminal_reward, transition.reward, over)
    reward = mean if spread is None else penalised(mean, penalty, spread)
    all_stds = None
    if transition.std is not None and spread is not None:
        all_stds = torch.cat([transition.std, spread[:, None]], -1)
    return Moved(transition.q_next, q.new_zeros(len(q), 0, q.shape[1]), mean, reward, over, all_stds)


def move_particles(
    model: DynamicsModel,
    particles: Tensor,
    u: Tensor,
    penalty: float,
    noise: Tensor | None,
    *,
    process: Tensor | None = None,
    steps: ArraySteps | None = None,
) -> Moved:
    """Predict one step of N lanes that are represented by particles (N, P, C), under u (N, F), one action for each lane
    (variant AUR-P of the paper).

    The next state is the mean of the particles. The reward is a weighted mean of the particles' penalised rewards, with
    weights 1/U, where U is the variance of a particle's reward (eq. 7).

    Args:
        model: the model.
        particles: particles before the step.
        u: actions.
        penalty: number of standard deviations to subtract from each particle's reward (eq. 14).
        noise: (N, P, M) standard normal numbers by which each particle samples its next state; None for the mean.
        process: (N, P, M) standard normal numbers, by which the learned noise moves each particle, or None for no
            noise.
        steps: compiled steps of the model, or None to use ``DynamicsModel.transition``.
    """
    lanes, count, size = particles.shape
    q, action = particles.flatten(0, 1), u.repeat_interleave(count, 0)
    flat_noise, flat_process = (None if n is None else n.flatten(0, 1) for n in (noise, process))
    transition = (model.transition if steps is None else partial(_compiled_transition, steps))(
        q, action, noise=flat_noise, process=flat_process, stds=True, reward_std=True
    )
    require_shapes(model, transition, q)
    spread = transition.reward_std
    assert transition.std is not None
    assert spread is not None
    moved = transition.q_next.reshape(lanes, count, size)
    output = mean_state(model.definition, moved)
    over = model.terminated(output)
    mean = paid(model.terminal_reward, transition.reward, over.repeat_interleave(count))
    weight = _weights(spread.reshape(lanes, count), model.scales[-1])
    std = torch.cat([transition.std, spread[:, None]], -1).reshape(lanes, count, len(model.definition.outputs))
    return Moved(
        output,
        moved,
        (weight * mean.reshape(lanes, count)).sum(1),
        (weight * penalised(mean, penalty, spread).reshape(lanes, count)).sum(1),
        over,
        std.square().mean(1).sqrt(),
    )


def _compiled_transition(
    steps: ArraySteps,
    q: Tensor,
    u: Tensor,
    *,
    noise: Tensor | None,
    process: Tensor | None,
    stds: bool,
    reward_std: bool,
) -> Transition:
    """Predict one step with a model's compiled code, with the arguments and the result of
    ``DynamicsModel.transition``."""
    shaken, shaped = (None if n is None else n.contiguous().numpy() for n in (noise, process))
    moved = steps(
        q.contiguous().numpy(),
        u.to(q.dtype).contiguous().numpy(),
        noise=shaken,
        process=shaped,
        paths=None,
        stds=stds,
        reward_std=reward_std,
    )
    std = torch.from_numpy(moved.std)
    return Transition(torch.from_numpy(moved.q_next), torch.from_numpy(moved.reward), std[:, :-1], std[:, -1])


def penalised(reward: Tensor, penalty: float, std: Tensor) -> Tensor:
    """Return the rewards (m,) less ``penalty`` times their standard deviations ``std`` (m,), eq. 14."""
    return reward - penalty * std


def mean_state(definition: EnvironmentDefinition, particles: Tensor) -> Tensor:
    """Return the mean state (N, C) of the P particles (N, P, C) of each of N lanes. The mean of an angle is the
    direction of the mean of its cosines and sines."""
    mean = particles.mean(1)
    for index in definition.angles:
        angle = particles[..., index]
        mean[:, index] = torch.atan2(angle.sin().mean(1), angle.cos().mean(1))
    return mean


def _weights(spread: Tensor, scale: Tensor) -> Tensor:
    """Return weights (N, P) of the P particles of each of N lanes, proportional to 1 / ``spread`` ** 2. The weights of
    a lane add up to 1.

    ``spread`` (N, P) has the standard deviation of each particle's reward, and ``scale`` is that of the reward over
    the samples.
    """
    precision = 1 / (spread.square() + WEIGHT_FLOOR * scale**2).clamp_min(LEAST_VARIANCE)
    return precision / precision.sum(1, keepdim=True)
