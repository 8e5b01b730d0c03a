"""Distinguish the influence of earlier steps from noise, by consecutive steps of one episode.

A dead time, or a state that is not measured, makes equal steps differ, as noise does. But then earlier steps predict
the difference: their actions u_{t-1}, u_{t-2}, ..., or the change d_{t-1} = q_t - q_{t-1} in the step before. The test
compares linear regressions of the increments, and of the model's residuals r_t, by leave-one-out errors:

    on state and action (q_t, u_t) alone, and on (q_t, u_t, d_{t-1}, u_{t-1}, ...), with the past.

The explained share is 1 less the ratio of the smallest squared error with the past to the smallest without the past,
where the model's own squared error counts as one without the past.

Noise of the process is independent of the past. An error e of a sensor falsifies the end of one step and the start of
the next: r_t = e_{t+1} - a e_t. The past contains e_t - a e_{t-1} at best, which explains at most a quarter of r_t.
Earlier changes would explain more of it, so they are left out. If the share reaches ``EXPLAINED``, noise is ruled out.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples, increments, preceding
from surrogym_server.models.abilities import AtSamples, LeaveOneOut, SampledFunctions, offers
from surrogym_server.models.port import DynamicsModel

# Earlier steps count as a cause of the model's errors only if they explain at least this share of the squared errors.
EXPLAINED = 0.5
PAIRS = 3  # a regression needs at least this many pairs of consecutive steps for each of its coefficients
DEPTHS = (1, 3)  # numbers of earlier actions that the regressions include; a dead time of more steps is not found
MOST = 400  # greatest number of samples in the test, because its time grows with their third power
RIDGE = 1e-6  # ridge parameter of the regressions, relative to the variance of the inputs


def owed_to_past(model: DynamicsModel, samples: Samples, limits: Sequence[float]) -> tuple[float, ...]:
    """Return the share of the model's squared error in each output that earlier steps of the episode explain, (O,), as
    with a dead time or a hidden state.

    The share counts as 0 if it is below ``EXPLAINED``, if the error is within the output's tolerance in ``limits``
    (O,), or if there are too few consecutive steps. It is 0 for the reward.
    """
    definition, able, errors = model.definition, offers(model, SampledFunctions), offers(model, LeaveOneOut)
    nothing = (0.0,) * len(definition.outputs)
    newest = samples.at(torch.arange(max(0, len(samples) - MOST), len(samples)))
    follows = preceding(definition, newest)
    if able is None or errors is None or not bool((follows >= 0).any()):
        return nothing
    now = torch.cat([_state(definition, newest.q), newest.u], -1)
    pasts = [_past(newest.u, increments(definition, newest), follows, depth) for depth in DEPTHS]
    shares = [
        max(_explained_share(at, now, *past) for past in pasts)
        if one.error > limit and (at := able.at_samples(newest, column)) is not None
        else 0.0
        for column, (one, limit) in enumerate(zip(errors.leave_one_out()[:-1], limits, strict=False))
    ]
    return (*shares, 0.0)


def pairs_lacking(definition: EnvironmentDefinition, samples: Samples) -> int:
    """Return how many more pairs of consecutive steps than the samples contain are needed for the test whether earlier
    steps explain errors of a model."""
    state, size, changes = _state(definition, samples.q[:1]).shape[1], samples.u.shape[1], len(definition.moving)
    enough = PAIRS * (state + size + changes + DEPTHS[0] * size + 1)
    return max(0, enough - int((preceding(definition, samples) >= 0).sum()))


def _state(definition: EnvironmentDefinition, q: Tensor) -> Tensor:
    """Return the coordinates of n states q (n, C), with cosine and sine in place of each angle."""
    turning = torch.tensor([c.kind == "angle" for c in definition.coordinates])
    return torch.cat([q[:, ~turning], q[:, turning].cos(), q[:, turning].sin()], -1)


def _past(u: Tensor, change: Tensor, follows: Tensor, depth: int) -> tuple[Tensor, Tensor]:
    """Return the past of each of n samples, (n, d): the change of the state in the step before, then the actions of the
    ``depth`` steps before. Return also whether all of it is known, (n,) bool.

    Args:
        u: actions (n, F).
        change: change of the state in each sample, (n, M).
        follows: (n,) index of the sample that is the step before, -1 if there is none.
        depth: number of earlier actions.
    """
    place, complete, columns = torch.arange(len(follows)), torch.ones(len(follows), dtype=torch.bool), [change[follows]]
    for _ in range(depth):
        # If there is no step before, ``place`` is -1, which selects the last row; ``complete`` excludes this sample.
        place = follows[place]
        complete &= place >= 0
        columns.append(u[place])
    return torch.cat(columns, -1), complete


def _explained_share(at: AtSamples, now: Tensor, past: Tensor, complete: Tensor) -> float:
    """Return the share of an output's squared error at n samples that their past explains, in addition to state and
    action.

    Args:
        at: values of the output at the samples, and covariance of its process.
        now: (n, e) features of state and action.
        past: (n, d) features of the past of each sample: the change of the state in the step before, and earlier
            actions.
        complete: (n,) bool, whether the past of each sample is known. Other samples are not used.
    """
    some = complete[at.rows]
    x, y, r = now[at.rows][some], at.targets[some], _residuals(at)[some]
    whole = torch.cat([x, past[at.rows][some]], -1)
    if len(y) < PAIRS * (whole.shape[1] + 1):
        return 0.0
    without = min(float(r.square().sum()), _left_out(x, y), _left_out(x, r))
    share = 1 - min(_left_out(whole, y), _left_out(whole, r)) / max(without, 1e-300)
    return share if share >= EXPLAINED else 0.0


def _left_out(x: Tensor, y: Tensor) -> float:
    """Return the sum of the squared leave-one-out errors of a linear regression of y (n,) on x (n, d)."""
    spread = x.std(0)
    z = torch.cat([torch.ones_like(y)[:, None], (x - x.mean(0)) / torch.where(spread > 0, spread, 1.0)], -1)
    hat = z @ torch.linalg.solve(z.T @ z + RIDGE * len(z) * torch.eye(z.shape[1], dtype=z.dtype), z.T)
    return float(((y - hat @ y) / (1 - hat.diagonal()).clamp_min(1e-6)).square().sum())


def _residuals(at: AtSamples) -> Tensor:
    """Return the leave-one-out errors of an output's process at its k samples, (k,): each target less the prediction
    from the other samples."""
    noisy = at.covariance + at.noise_variance * torch.eye(len(at.targets), dtype=at.covariance.dtype)
    inverse = torch.linalg.inv(noisy)
    residuals: Tensor = (inverse @ at.targets) / inverse.diagonal()
    return residuals
