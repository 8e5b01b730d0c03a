"""What a swing-up can earn on the rail of ``bench_kept_limits.py``: a planner with the exact equations.

    python lab/benchmarks/rail_bound.py --first-seed 10000 --episodes 10

Each force is chosen by the cross-entropy method on rollouts of the exact equations: without a limit, with a cost of
leaving the rail, and with the guard. Each start has several horizons, of which the best return counts. Prints the mean
return, the largest position, and the share of steps in which the fallback acted. A better search may find more.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
import torch
from bench_kept_limits import PLANTS, specifications

from surrogym_sampler import original
from surrogym_sampler.original.episode import Episode
from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.original.loading import Respecified
from surrogym_sampler.original.swingup import GRAVITY, LENGTH, MAX_FORCE, STEP_SECONDS, WIDTH

CART = POLE = 0.5  # kg
FRICTION = 0.1
PARTS = 2  # steps of the Runge-Kutta rule in a step of the environment
HORIZONS, ROUNDS, SAMPLES, ELITE, COLOUR = (12, 20, 30), 6, 512, 20, 0.6
RAIL, MARGIN, AHEAD = 0.8, 0.4, 0.2  # m, m, s: the limit of ``bench_kept_limits.py``
STEPS = 40
Tensor = torch.Tensor
TERM = torch.tensor([1.0, AHEAD, 0.0, 0.0], dtype=torch.float64)
FALLBACK = torch.tensor([-8.0, -6.0, 0.0, 0.0], dtype=torch.float64)


def derivative(q: Tensor, u: Tensor) -> Tensor:
    """Time derivative of states (N, 4) under forces (N,), as ``swingup.py`` has it."""
    _, v, angle, omega = q.unbind(-1)
    sin, cos, total = angle.sin(), angle.cos(), CART + POLE
    push, swing = u - FRICTION * v, POLE * LENGTH * omega**2 * sin
    weight = 4 * total - 3 * POLE * cos**2
    acceleration = (2 * swing + 3 * POLE * GRAVITY * sin * cos + 4 * push) / weight
    angular = -3 * (swing * cos + 2 * total * GRAVITY * sin + 2 * push * cos) / (LENGTH * weight)
    return torch.stack([v, acceleration, omega, angular], -1)


def rolled(start: Tensor, before: Tensor, forces: Tensor, *, guarded: bool) -> Tensor:
    """States (T + 1, N, 4) under forces (T, N) from a start (4,) after the state ``before`` (4,). The fallback
    acts in place of a force near the limit if the guard is on."""
    many, h = forces.shape[1], STEP_SECONDS / PARTS
    path, earlier = [start.expand(many, 4)], before.expand(many, 4) @ TERM
    for u in forces:
        q = path[-1]
        if guarded:
            now = q @ TERM
            near = torch.maximum(now.abs(), (2 * now - earlier).abs()) > RAIL - MARGIN
            u = torch.where(near, (q @ FALLBACK).clamp(-MAX_FORCE, MAX_FORCE), u)
            earlier = now
        for _ in range(PARTS):
            k1 = derivative(q, u)
            k2 = derivative(q + h / 2 * k1, u)
            k3 = derivative(q + h / 2 * k2, u)
            q = q + h / 6 * (k1 + 2 * k2 + 2 * k3 + derivative(q + h * k3, u))
        path.append(q)
    return torch.stack(path)


def earned(path: Tensor) -> Tensor:
    """Return (N,) of each episode."""
    x, angle = path[1:, :, 0], path[1:, :, 2]
    across, below = x + LENGTH * angle.sin(), LENGTH * (1 + angle.cos())
    return (-(across**2 + below**2) / (2 * WIDTH["smooth"] ** 2)).exp().sum(0)


# Whether the guard is on, and the cost of each metre beyond the rail.
ROWS = {"no limit": (False, 0.0), "rail": (False, 50.0), "guard": (True, 0.0)}


class Search:
    """Chooses each force by the cross-entropy method on rollouts of ``horizon`` steps with the exact equations."""

    def __init__(self, row: str, horizon: int) -> None:
        self.horizon, (self.guarded, self.beyond) = horizon, ROWS[row]
        self.mean, self.drawn = torch.zeros(horizon, dtype=torch.float64), torch.Generator()
        self.drawn.manual_seed(0)

    def force(self, state: Tensor, before: Tensor) -> float:
        """The force in a state (4,), where ``before`` (4,) is the state one step earlier."""
        mean, std = self.mean, torch.full((self.horizon,), MAX_FORCE, dtype=torch.float64)
        for _ in range(ROUNDS):
            noise = torch.randn(self.horizon, SAMPLES, generator=self.drawn, dtype=torch.float64)
            for step in range(1, self.horizon):  # changes of two steps in a row are correlated
                noise[step] = COLOUR * noise[step - 1] + (1 - COLOUR**2) ** 0.5 * noise[step]
            noise[:, 0] = 0.0
            forces = (mean[:, None] + std[:, None] * noise).clamp(-MAX_FORCE, MAX_FORCE)
            path = rolled(state, before, forces, guarded=self.guarded)
            beyond = (path[..., 0].abs() - RAIL).relu().sum(0)
            value = earned(path) - self.beyond * beyond
            best = forces[:, value.topk(ELITE).indices]
            mean, std = best.mean(1), best.std(1)
        mean = best[:, 0]
        self.mean = torch.cat([mean[1:], mean[-1:]])
        return float(mean[0])


def main() -> None:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--first-seed", type=int, default=10_000)
    made.add_argument("--episodes", type=int, default=10)
    options = made.parse_args()
    torch.set_num_threads(1)
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    kept, free = specifications(PLANTS["rail"], 0)
    for name, (guarded, *_) in ROWS.items():
        spec = kept if guarded else free
        plant = original.make("surrogym/CartPoleSwingUp-v0", access="reset")
        environment = open_episode("plant:Plant", spec, lambda spec=spec, plant=plant: Respecified(plant, spec))
        found = [
            max(episode(environment, number, Search(name, horizon)) for horizon in HORIZONS)
            for number in range(options.first_seed, options.first_seed + options.episodes)
        ]
        returns, farthest, fallbacks = np.array(found).T
        words = f"{returns.mean():.2f} ({returns.min():.2f} to {returns.max():.2f}), at most {farthest.max():.2f} m"
        print(f"{name}: return {words}, fallback in {fallbacks.mean() / STEPS:.1%} of the steps")


def episode(environment: Episode, seed: int, search: Search) -> tuple[float, float, int]:
    """Return the return, the largest position and the number of steps with the fallback of an episode."""
    moment, total, farthest, fallbacks = environment.reset(seed), 0.0, 0.0, 0
    before = torch.tensor(moment.coordinates, dtype=torch.float64)
    for _ in range(STEPS):
        state = torch.tensor(moment.coordinates, dtype=torch.float64)
        moment, before = environment.step(np.array([search.force(state, before)])), state
        total, farthest = total + moment.reward, max(farthest, abs(float(moment.coordinates[0])))
        fallbacks += moment.fell_back
    return total, farthest, fallbacks


if __name__ == "__main__":
    main()
