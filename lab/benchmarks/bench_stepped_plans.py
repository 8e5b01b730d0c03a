"""Plans in a calibrated simulator with contacts: what its steps allow, without a model and without a policy search.

    python lab/benchmarks/bench_stepped_plans.py --tasks finger-spin ball_in_cup-catch --seeds 2 3

Needs dm_control. For each seed, each mass, damping, friction and gear of the plant is the simulator's, 20 to 30 % more
or less. The simulator is calibrated on ``--steps`` random real steps from resets. Then each action of a real episode of
1,000 steps is planned anew by the cross-entropy method (R. Rubinstein, 1999) with MuJoCo's rollouts: in the calibrated
simulator, and in the simulator as it is. Prints the returns; nothing is learned.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from bench_contacts import taken
from bench_priors import scaled
from mujoco.rollout import Rollout

from surrogym_sampler import original
from surrogym_sampler.original.protocol import Array, RealStep
from surrogym_sampler.priors.calibration import RealTransitions, adjustable, calibrate, layers, read_parameters
from surrogym_shared.spec import EnvironmentSpec

EPISODE, PLANS, ELITE, ROUNDS, HORIZON, HELD = 1_000, 64, 8, 2, 40, 5


def main() -> None:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--tasks", nargs="+", default=["finger-spin", "ball_in_cup-catch"])
    made.add_argument("--seeds", nargs="+", type=int, required=True)
    made.add_argument("--steps", type=int, default=100)
    options = made.parse_args()
    for task in options.tasks:
        for seed in options.seeds:
            run(task, seed, options.steps)


def opened(task: str, **choices: Any) -> Any:
    read = json.loads((Path(__file__).parent / "larger" / f"{task}.json").read_bytes())
    spec = EnvironmentSpec.model_validate(read.get("specification", read))
    return original.make(f"dm_control:{task}", spec=spec, **choices)


def run(task: str, seed: int, count: int) -> None:
    rng = np.random.default_rng([seed, 59])
    simulator = opened(task)
    own = adjustable(simulator)
    names = tuple(own.parameters())
    factors = 1 + rng.choice([-1, 1], len(names)) * rng.uniform(0.2, 0.3, len(names))
    plant = scaled(opened(task, access="reset"), names, factors)
    truth, real = adjustable(plant).parameters(), transitions(taken(plant, rng, count))
    before = np.array([own.parameters()[name] for name in names])

    def step(values: Any, q: Any, u: Any) -> Any:
        own.set_parameters(dict(zip(names, values.tolist(), strict=True)))
        return simulator.step_from(q, u).next_coordinates

    begun = time.process_time()
    found = calibrate(plant.spec(), real, read_parameters(names, own), before, step)
    inside = sum(one.low <= truth[one.name] <= one.high for one in found.parameters)
    print(
        f"{task} {seed}: {count} real steps, error {found.error_before:.3g} -> {found.error:.2g}, {inside} of "
        f"{len(names)} intervals with the true value, {time.process_time() - begun:.0f} s",
        flush=True,
    )
    arms = {"calibrated": found.values, "as it is": dict(zip(names, before, strict=True))}
    for words, values in arms.items():
        own.set_parameters(values)
        begun = time.process_time()
        earned = episode(task, plant, layers(simulator)[-1]._physics, seed)
        print(
            f"{task} {seed}: planned in the simulator, {words}: {earned:.0f}; {time.process_time() - begun:.0f} s",
            flush=True,
        )


def transitions(steps: list[RealStep]) -> RealTransitions:
    columns = ("coordinates", "action", "next_coordinates")
    return RealTransitions(*(np.array([getattr(step, name) for step in steps]) for name in columns))


def episode(task: str, plant: Any, physics: Any, seed: int) -> float:
    """Return of a real episode whose actions are planned in the simulator's physics."""
    rng, model, data = np.random.default_rng([seed, 60]), physics.model.ptr, physics.data.ptr
    value, held = VALUES[task](physics), layers(plant)[-1]
    pool, datas = Rollout(nthread=2), [mujoco.MjData(model) for _ in range(2)]
    parts, inside = HORIZON // HELD, held._physics.data
    low, high = np.array(held.action.low), np.array(held.action.high)
    plan, total = np.zeros((parts, len(low))), 0.0
    plant.begin(seed)
    for number in range(EPISODE):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = inside.qpos, inside.qvel
        start = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        mujoco.mj_getState(model, data, start, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        width = np.full_like(plan, 0.6)
        for _ in range(ROUNDS):
            plans = np.clip(plan + width * rng.standard_normal((PLANS, *plan.shape)), low, high)
            plans[0] = plan
            controls = np.repeat(plans, HELD * held._substeps, axis=1)
            states = pool.rollout(model, datas, np.tile(start, (PLANS, 1)), controls)[0][
                :, held._substeps - 1 :: held._substeps
            ]
            best = plans[np.argsort(-value(states[..., 1 : 1 + model.nq], states[..., 1 + model.nq :]))[:ELITE]]
            plan, width = best.mean(0), best.std(0) + 0.1
        total += plant.act(plan[0]).reward
        if (number + 1) % HELD == 0:
            plan = np.concatenate([plan[1:], plan[-1:]])
    pool.close()
    return total


def spun(physics: Any) -> Any:
    """Value of rollouts (n,) from positions (n, T, 3) and speeds (n, T, 3): the hinge's speed, up to the reward's."""
    del physics

    def value(q: Array, v: Array) -> Array:
        del q
        return np.asarray(np.minimum(-v[..., 2] / 15, 1.1).sum(-1))

    return value


def caught(physics: Any) -> Any:
    """Value of rollouts (n,): steps with the ball in the cup, and its distance."""
    mujoco.mj_resetData(physics.model.ptr, physics.data.ptr)
    mujoco.mj_forward(physics.model.ptr, physics.data.ptr)
    size = physics.named.model.site_size["target", [0, 2]] - physics.named.model.geom_size["ball", 0]
    apart = np.array(physics.ball_to_target())

    def value(q: Array, v: Array) -> Array:
        del v
        off = np.abs(apart + q[..., :2] - q[..., 2:4])
        return np.asarray(((off < size).all(-1) - np.linalg.norm(off, axis=-1)).sum(-1))

    return value


VALUES = {"finger-spin": spun, "ball_in_cup-catch": caught}

if __name__ == "__main__":
    main()
