"""Tell what a step owes to the steps before it from noise, by consecutive steps of one episode.

A dead time, or a state that is not measured, makes equal steps differ, as noise does. But then the residual r_t of a
step depends on the steps before: on their actions u_{t-1}, u_{t-2}, ..., or on the change d_{t-1} = q_t - q_{t-1} that
led to this one. A linear regression on them predicts each residual from all others.

Noise of the process is independent of them. A sensor's error e falsifies the end of one step and the start of the next:
r_t = e_{t+1} - a e_t and d_{t-1} = e_t - e_{t-1} + (a change without error). From such a sum nothing can predict more
than half of the variance of e_t; earlier changes would tell more of it, so they are left out. So a past that explains
more than ``EXPLAINED`` is no noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from surrogym_server.environment.samples import Samples, increments, preceding
from surrogym_server.models.abilities import AtSamples, LeaveOneOut, SampledFunctions, offers
from surrogym_server.models.port import DynamicsModel

EXPLAINED = 0.5  # of the squared residuals
PAIRS = 4  # consecutive steps for each coefficient of the regression, at least
DEPTHS = (1, 3)  # earlier actions; a longer dead time needs more, and more steps to show it
MOST = 400  # samples in a test, because its time grows with their third power
RIDGE = 1e-6  # of the inputs' variance


def owed_to_past(model: DynamicsModel, samples: Samples, limits: Sequence[float]) -> tuple[float, ...]:
    """Share of each output's squared residuals (O,) that the steps before explain. It is 0 if that share is below
    ``EXPLAINED``, if the residuals are within the limit (O,), or if there are too few consecutive steps."""
    definition, able, errors = model.definition, offers(model, SampledFunctions), offers(model, LeaveOneOut)
    nothing = (0.0,) * len(definition.outputs)
    newest = samples.at(torch.arange(max(0, len(samples) - MOST), len(samples)))
    follows = preceding(definition, newest)
    if able is None or errors is None or not bool((follows >= 0).any()):
        return nothing
    pasts = [_past(newest.u, increments(definition, newest), follows, depth) for depth in DEPTHS]
    shares = [
        max(_explained(at, *past) for past in pasts)
        if one.error > limit and (at := able.at_samples(newest, column)) is not None
        else 0.0
        for column, (one, limit) in enumerate(zip(errors.leave_one_out()[:-1], limits, strict=False))
    ]
    return (*shares, 0.0)


def _past(u: Tensor, change: Tensor, follows: Tensor, depth: int) -> tuple[Tensor, Tensor]:
    """The last change and ``depth`` actions before each of n samples (n, d), and which of these are known (n,)."""
    place, known, columns = torch.arange(len(follows)), torch.ones(len(follows), dtype=torch.bool), [change[follows]]
    for _ in range(depth):
        place = follows[place]  # a row without a step before stays unknown
        known &= place >= 0
        columns.append(u[place])
    return torch.cat(columns, -1), known


def _explained(at: AtSamples, past: Tensor, known: Tensor) -> float:
    """Share of the squared residuals at n samples that their ``past`` (n, d) explains, where it is ``known`` (n,)."""
    some = known[at.rows]
    x, r = past[at.rows][some], _residuals(at)[some]
    if len(r) < PAIRS * (x.shape[1] + 1):
        return 0.0
    spread = x.std(0)
    z = torch.cat([torch.ones_like(r)[:, None], (x - x.mean(0)) / torch.where(spread > 0, spread, 1.0)], -1)
    hat = z @ torch.linalg.solve(z.T @ z + RIDGE * len(z) * torch.eye(z.shape[1], dtype=z.dtype), z.T)
    left = (r - hat @ r) / (1 - hat.diagonal()).clamp_min(1e-6)  # errors of residuals that were left out
    share = 1 - float(left.square().sum() / r.square().sum().clamp_min(1e-300))
    return share if share >= EXPLAINED else 0.0


def _residuals(at: AtSamples) -> Tensor:
    """Errors (k,) of each target's prediction from all others."""
    noisy = at.covariance + at.noise_variance * torch.eye(len(at.targets), dtype=at.covariance.dtype)
    inverse = torch.linalg.inv(noisy)
    residuals: Tensor = (inverse @ at.targets) / inverse.diagonal()
    return residuals
