"""How often a swing-up with noisy sensors can be upright: a linear-quadratic-Gaussian controller with its equations.

    python lab/benchmarks/noise_bound.py --seeds 0 121

The controller knows the machine of each seed (``dirty_swingup.py``) exactly: a Kalman filter with the machine's own
step, and a linear-quadratic regulator about the upright rod. Episodes begin near upright. The weights are those of a
small grid with the highest share. A rod is upright if it is so in each of the last 20 of 40 steps. Prints a line for
each seed and size of the noise, in percent of each range.
"""

from __future__ import annotations

import argparse
import itertools
import math
from typing import Any

import numpy as np
from dirty_swingup import HELD, UP, DirtySwingUp
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from surrogym_sampler.original.swingup import swing_up
from surrogym_shared.spec import limits

Floats = NDArray[np.float64]
UPRIGHT = np.array([0.0, 0.0, math.pi, 0.0])
STEPS = 40
CHANGE = 1e-5  # step of the numerical derivatives
POSITIONS, PUSHES = (0.1, 1.0, 10.0), (1e-4, 1e-3, 1e-2)  # weights of the cart's position, and of the force


def main() -> None:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--seeds", nargs="+", type=int, required=True)
    made.add_argument("--noise", nargs="+", type=float, default=(1.0, 3.0), help="percent of each range")
    made.add_argument("--episodes", type=int, default=60)
    options = made.parse_args()
    for seed in options.seeds:
        machine = DirtySwingUp("clean", seed)
        machine.reset(0)
        a = np.stack([_slope(machine, CHANGE * axis, 0.0) for axis in np.eye(4)], 1)
        b = _slope(machine, np.zeros(4), CHANGE)[:, None]
        print(f"seed {seed}: a deviation grows by {np.abs(np.linalg.eigvals(a)).max():.2f} in a step")
        for percent in options.noise:
            weights = itertools.product(POSITIONS, PUSHES)
            best = max(_share(machine, a, b, percent / 100, *given, options.episodes) for given in weights)
            print(
                f"seed {seed}: noise of {percent:g} %: upright in {best:.0%} of {options.episodes} episodes", flush=True
            )


def _step(machine: Any, state: Floats, force: float) -> Floats:
    machine.q, machine.v = state[[0, 2]].copy(), state[[1, 3]].copy()
    machine.step(force)
    return np.array([machine.q[0], machine.v[0], machine.q[1], machine.v[1]])


def _slope(machine: Any, change: Floats, force: float) -> Floats:
    above, below = (_step(machine, UPRIGHT + sign * change, sign * force) for sign in (1, -1))
    return (above - below) / (2 * CHANGE)


def _share(machine: Any, a: Floats, b: Floats, noise: float, position: float, push: float, episodes: int) -> float:
    """Return the share of episodes in which the rod is upright."""
    spans = [high - low for low, high in (limits(c.sampling) for c in swing_up().coordinates)]
    spread, force = noise * np.array(spans), swing_up().action.ranges[0]
    cost = solve_discrete_are(a, b, np.diag([position, 0.01, 10.0, 0.1]), np.array([[push]]))
    regulator = np.linalg.solve(b.T @ cost @ b + push, b.T @ cost @ a)
    r = np.diag(spread**2)
    uncertain = solve_discrete_are(a.T, np.eye(4), 1e-10 * np.eye(4), r)
    gain, rng, held = uncertain @ np.linalg.inv(uncertain + r), np.random.default_rng(0), 0
    for _ in range(episodes):
        state = UPRIGHT + rng.normal(size=4) * [0.05, 0.1, 0.05, 0.1]
        known, up = state + rng.normal(size=4) * spread, 0
        for _ in range(STEPS):
            u = float(np.clip(-(regulator @ (known - UPRIGHT))[0], *force))
            state, expected = _step(machine, state, u), _step(machine, known, u)
            known = expected + gain @ (state + rng.normal(size=4) * spread - expected)
            up = up + 1 if math.cos(state[2]) < UP else 0
        held += up >= HELD
    return held / episodes


if __name__ == "__main__":
    main()
