"""How honest predictive distributions are: coverage and interval score, on trajectories that no model has seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from surrogym_lab.reproduce.statistics import interval_score
from surrogym_sampler.original.gymnasium import GymnasiumEnvironment
from surrogym_server.convert import definition_from_spec
from surrogym_server.models.abilities import FunctionDraws
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.latin_hypercube import random_points
from surrogym_shared.spec import EnvironmentSpec

Array = np.ndarray
HORIZON = 10
LEVELS = (0.5, 0.8, 0.9)  # probabilities of the central intervals that are scored


@dataclass(frozen=True)
class Trajectories:
    """b real ones from anywhere, under random actions: q (b, T + 1, C), u (b, T, F), reward (b, T)."""

    q: Array
    u: Array
    reward: Array


@dataclass(frozen=True)
class Calibration:
    """Of m predictions of O outputs each.

    ``coverage`` of intervals of each level: an error within the tolerance is no fault, and counts only where the 90 %
    interval reaches beyond the tolerance, so that certainty that is deserved adds nothing. ``interval_score`` is the
    mean score of the 90 % interval (Gneiting and Raftery 2007, eq. 43), over the tolerance. ``counted`` is the share of
    predictions that coverage is over.
    """

    coverage: tuple[float, ...]
    interval_score: float
    counted: float

    @classmethod
    def of(cls, drawn: Array, truth: Array, tolerance: Array) -> Calibration:
        """Of draws (s, m, O), what happened (m, O), and tolerances (O,)."""
        ends = {level: np.quantile(drawn, [0.5 - level / 2, 0.5 + level / 2], axis=0) for level in LEVELS}
        middle = np.median(drawn, 0)
        small = np.abs(truth - middle) <= tolerance
        low, high = ends[LEVELS[-1]]
        counted = ~small | ((high - low) / 2 > tolerance)
        right = {level: small | ((truth >= a) & (truth <= b)) for level, (a, b) in ends.items()}
        low, high = np.minimum(low, middle - tolerance), np.maximum(high, middle + tolerance)
        score = interval_score(low, high, truth, LEVELS[-1]) / tolerance
        shares = tuple(float(right[level][counted].mean()) if counted.any() else np.nan for level in LEVELS)
        return cls(shares, float(score.mean()), float(counted.mean()))


def trajectories(spec: EnvironmentSpec, count: int, seed: int) -> Trajectories:
    """Real ones of ``HORIZON`` steps that do not end before."""
    definition, original = definition_from_spec(spec), GymnasiumEnvironment(spec)
    rng = np.random.default_rng(seed)
    rows: list[tuple[Array, Array, Array]] = []
    while len(rows) < count:
        q, u = random_points(definition, HORIZON, rng)
        path, paid = [q[0].numpy()], []
        for action in u.numpy():
            step = original.step_from(path[-1], action)
            if step.terminated:
                break
            path.append(np.asarray(step.next_coordinates, dtype=float))
            paid.append(step.reward)
        if len(paid) == HORIZON:
            rows.append((np.array(path), u.numpy(), np.array(paid)))
    original.close()
    return Trajectories(*(np.stack(parts) for parts in zip(*rows, strict=True)))


def one_step(
    model: DynamicsModel, draws: FunctionDraws, paths: torch.Tensor, real: Trajectories
) -> tuple[Array, Array]:
    """Draws (s, m, O) and truth (m, O) one step ahead, of one step of each trajectory."""
    at = np.arange(len(real.q)) % HORIZON
    each = np.arange(len(real.q))
    step = _along(draws, paths, real.q[each, at], real.u[each, at])
    return outputs(model, *step, real.q[each, at + 1], real.reward[each, at])


def ten_steps(
    model: DynamicsModel, draws: FunctionDraws, paths: torch.Tensor, real: Trajectories
) -> tuple[Array, Array]:
    """The same after ``HORIZON`` steps, each draw along its own function; the reward is that of all of them."""
    count, q = len(paths), np.repeat(real.q[None, :, 0], len(paths), 0)
    paid = np.zeros(q.shape[:2])
    for time in range(HORIZON):
        moved = draws.transition_along(
            paths.repeat_interleave(len(real.q), 0),
            torch.from_numpy(q.reshape(-1, q.shape[2])),
            torch.from_numpy(real.u[:, time]).repeat(count, 1),
        )
        q = moved.q_next.numpy().reshape(q.shape)
        paid += moved.reward.numpy().reshape(paid.shape)
    return outputs(model, q, paid, real.q[:, -1], real.reward.sum(1))


def _along(draws: FunctionDraws, paths: torch.Tensor, q: Array, u: Array) -> tuple[Array, Array]:
    """Next states (s, m, C) and rewards (s, m) of every draw from q (m, C) under u (m, F)."""
    count, m = len(paths), len(q)
    moved = draws.transition_along(
        paths.repeat_interleave(m, 0), torch.from_numpy(q).repeat(count, 1), torch.from_numpy(u).repeat(count, 1)
    )
    return moved.q_next.numpy().reshape(count, m, -1), moved.reward.numpy().reshape(count, m)


def outputs(model: DynamicsModel, q: Array, paid: Array, q_real: Array, reward: Array) -> tuple[Array, Array]:
    """What moves, and the reward; angles of draws by the shorter way from the real ones."""
    definition = model.definition
    q = q.copy()
    for index in definition.angles:
        q[..., index] = q_real[:, index] + (q[..., index] - q_real[:, index] + np.pi) % (2 * np.pi) - np.pi
    moving = list(definition.moving)
    drawn = np.concatenate([q[..., moving], paid[..., None]], -1)
    return drawn, np.concatenate([q_real[:, moving], reward[:, None]], -1)


def mean(calibrations: Sequence[Calibration]) -> Calibration:
    """Over designs: coverage weighted by what it counts; the geometric mean of scores, whose sizes differ by task."""
    counted = np.array([c.counted for c in calibrations])
    shares = np.nan_to_num(np.array([c.coverage for c in calibrations]))
    total = counted.sum()
    coverage = tuple((counted @ shares / total).tolist()) if total else (np.nan,) * len(LEVELS)
    score = float(np.exp(np.mean([np.log(c.interval_score) for c in calibrations])))
    return Calibration(coverage, score, float(counted.mean()))
