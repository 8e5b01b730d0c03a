"""Scores of a model's predictions of held-out pieces: log density, and coverage of 90 % intervals.

A start is a held-out state from which the model is stepped under the real actions, along functions drawn from it and
with its learned noise. Its coordinates after h steps are compared with the real ones by a Student distribution with the
mean and the deviation of the draws. Its tails are heavy, as those of a deviation that a few functions show. So a single
surprise does not decide, which would have a normal distribution's density of e^-200 at 20 deviations. The reward is
compared after one step.

S starts, K draws, H steps, G pieces.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import torch
from torch import Tensor

from surrogym_server.environment.definition import wrap
from surrogym_server.environment.samples import Samples
from surrogym_server.models.abilities import LearnedNoise, offers
from surrogym_server.models.draws import function_draws
from surrogym_server.models.port import DynamicsModel

HORIZONS = (1, 5, 20)  # predicted steps
DRAWS = 32
STARTS, SPACING = 8, 5  # most starts in a piece, and least steps between them
FLOOR = 0.01  # least deviation, in those of the output's change in a step: smaller errors decide nothing
FREEDOM = 4  # degrees of freedom: those of the five networks of an ensemble
PEAK = math.lgamma((FREEDOM + 1) / 2) - math.lgamma(FREEDOM / 2) - 0.5 * math.log(FREEDOM * math.pi)  # log density
LEVEL = 0.9
WEIGHTS = 4_000_000  # of drawn functions in memory at once
SEED = 0


@dataclass(frozen=True)
class Scores:
    """Scores of one output on G pieces. NaN where a piece has nothing to compare."""

    density: Tensor  # (G,) log density in nats, of values in deviations of the output: mean over the horizons
    inside: Tensor  # (G,) share of the real values inside the interval


@dataclass(frozen=True)
class _Starts:
    rows: Tensor  # (S, H) samples along the steps; the last one is repeated where the piece has ended
    lengths: Tensor  # (S,) steps that the piece has
    piece: Tensor  # (S,)


def scores(model: DynamicsModel, samples: Samples, pieces: Sequence[Tensor], scale: Tensor) -> tuple[Scores, ...]:
    """Score every output (O,) of a model on pieces that it has not learned from; ``scale`` (O,) is the deviation of
    each output."""
    starts = _starts(pieces)
    states, reward = _rolled(model, samples, starts)
    found = []
    for column, index in enumerate(model.definition.moving):
        real = samples.q_next[starts.rows, index]
        error = states[..., index] - real[..., None]
        if model.definition.coordinates[index].kind == "angle":
            error = wrap(error)
        valid = torch.arange(error.shape[1]) < starts.lengths[:, None]
        found.append(_scored(error / scale[column], valid, 0.0, starts.piece, len(pieces)))
    first = starts.rows[:, :1]
    noise = offers(model, LearnedNoise)
    own = 0.0 if noise is None else noise.noise_deviations[-1] / float(scale[-1])
    error = (reward[:, None] - samples.reward[first][..., None]) / scale[-1]
    goes_on = ~samples.terminated[first]  # the reward of a terminating step includes the terminal reward
    return (*found, _scored(error, goes_on, own, starts.piece, len(pieces)))


def horizons_of(pieces: Sequence[Tensor]) -> tuple[int, ...]:
    """Horizons that the pieces are long enough for."""
    longest = max(map(len, pieces))
    return tuple(h for h in HORIZONS if h <= longest)


def _starts(pieces: Sequence[Tensor]) -> _Starts:
    steps = horizons_of(pieces)[-1]
    rows, lengths, owner = [], [], []
    for number, piece in enumerate(pieces):
        for begin in range(0, len(piece), max(SPACING, math.ceil(len(piece) / STARTS))):
            rows.append(piece[(begin + torch.arange(steps)).clamp_max(len(piece) - 1)])
            lengths.append(len(piece) - begin)
            owner.append(number)
    return _Starts(torch.stack(rows), torch.tensor(lengths), torch.tensor(owner))


def _rolled(model: DynamicsModel, samples: Samples, starts: _Starts) -> tuple[Tensor, Tensor]:
    """Coordinates (S, H, K, C) along K drawn functions, and the rewards (S, K) of the first steps."""
    functions = function_draws(model)
    generator = torch.Generator().manual_seed(SEED)
    noise = torch.randn(DRAWS, functions.path_size, generator=generator, dtype=torch.float64)
    paths = functions.draw(noise)
    at_once = max(1, WEIGHTS // (DRAWS * max(1, paths.shape[1])))
    states, rewards = [], []
    for rows in starts.rows.tensor_split(math.ceil(len(starts.rows) / at_once)):
        q, along = samples.q[rows[:, 0]].repeat_interleave(DRAWS, 0), paths.repeat(len(rows), 1)
        visited = []
        for step in range(rows.shape[1]):
            shape = (len(q), len(model.definition.moving))
            process = torch.randn(shape, generator=generator, dtype=torch.float64)
            u = samples.u[rows[:, step]].repeat_interleave(DRAWS, 0)
            made = functions.transition_along(along, q, u, process=process)
            q = made.q_next
            visited.append(q.reshape(len(rows), DRAWS, -1))
            if not step:
                rewards.append(made.reward.reshape(len(rows), DRAWS))
        states.append(torch.stack(visited, 1))
    return torch.cat(states), torch.cat(rewards)


def _scored(error: Tensor, valid: Tensor, noise: float, piece: Tensor, pieces: int) -> Scores:
    """Scores of draws less real values (S, H, K), in deviations of the output, where they are ``valid`` (S, H). The
    draws lack a noise of this deviation."""
    deviation = (error.var(-1) + noise**2 + FLOOR**2).sqrt()
    standard = error.mean(-1) / deviation
    density = PEAK - (FREEDOM + 1) / 2 * (standard.square() / FREEDOM).log1p() - deviation.log()
    inside = (standard.abs() <= NormalDist().inv_cdf((1 + LEVEL) / 2)).double()
    chosen = [h - 1 for h in HORIZONS if h <= error.shape[1]]
    return Scores(*(_by_piece(values[:, chosen], valid[:, chosen], piece, pieces) for values in (density, inside)))


def _by_piece(values: Tensor, valid: Tensor, piece: Tensor, pieces: int) -> Tensor:
    """Means (G,) over the horizons of the means over the starts of each piece, of values (S, horizons)."""
    shape = (pieces, values.shape[1])
    total = values.new_zeros(shape).index_add(0, piece, torch.where(valid, values, 0.0))
    counts = values.new_zeros(shape).index_add(0, piece, valid.to(values.dtype))
    return torch.nanmean(total / counts, 1)
