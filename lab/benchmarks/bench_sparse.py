"""Families of models with thousands of real steps of a large system: fit, steps, memory, errors and coverage.

python lab/benchmarks/bench_sparse.py
python lab/benchmarks/bench_sparse.py --task cheetah
python lab/benchmarks/bench_sparse.py --families sparse_gaussian_process --settings '{"inducing": 200}'

``chain`` is nine masses in a row between walls, joined by springs that stiffen with the cube, of which the first and
the last are pushed: 18 coordinates. ``cheetah`` is Gymnasium's HalfCheetah-v5 (MuJoCo), also 18 coordinates, with
contacts. A log has episodes of 100 random steps, and the held-out log has the next seed.

Each model is learned in a process of its own on one thread, as on a server, and stepped on ``--threads``. Errors are
root mean squares over held-out steps, in standard deviations of the output's change there: the median and the largest
of all transition outputs, and the reward's. "after 10" is the error of the state after ten predicted steps of the
held-out actions, in deviations of the state. Coverage is the share of held-out targets within the 90 % interval, the
learned noise included: the median, the least and the largest over the transition outputs, and the reward's. Rates are
environment steps of one session in process, a second by the clock and a second of processor time (of all threads
together): medians of the calls. On a busy machine only the second says something.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import gymnasium
import numpy as np
import torch
from common import parser, started, write

from surrogym_lab.unseen.machine import Machine
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples, increments
from surrogym_server.local import LocalSurrogate
from surrogym_server.models.abilities import LearnedNoise, offers
from surrogym_server.models.port import DynamicsModel
from surrogym_server.models.registry import learner_of
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    EnvironmentSpec,
    ModelChoice,
    ObservationEntry,
    Term,
    Uniform,
)
from surrogym_shared.wire import OpenSession

Array = np.ndarray[Any, Any]

EPISODE, HELD_OUT, AHEAD = 100, 2_000, 10  # steps of an episode, of the held-out log, and predicted ahead
MASSES, SUBSTEPS = 9, 5
WITHIN = 1.6448536269514722  # deviations on either side that hold 90 % of a normal distribution
MEBIBYTE = 1_024  # kibibytes
WARM_UP, SECONDS = 3, 4.0
FORMS: dict[str, dict[str, Any]] = {
    "mean": {},
    "function": {"variant": "pathwise"},
    "penalty": {"penalty": 1.0},
}


class Chain(Machine):
    """Nine masses in a row between walls, joined by springs that stiffen with the cube; the ends are pushed."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        f"{kind}{i}": (-1, 1) for kind in ("x", "v") for i in range(MASSES)
    }
    start: ClassVar[Mapping[str, tuple[float, float]]] = ranges
    actions = 2

    def formula(self, q: Array, u: Array) -> tuple[Array, Array]:
        x, v = q[..., :MASSES], q[..., MASSES:]
        pay = -(x**2).sum(-1) - 0.1 * (u**2).sum(-1)
        walls = np.zeros_like(x[..., :1])
        for _ in range(SUBSTEPS):
            stretch = np.diff(np.concatenate([walls, x, walls], -1), axis=-1)
            force = np.diff(stretch + 3 * stretch**3, axis=-1) - 0.2 * v
            force[..., 0] += 3 * u[..., 0]
            force[..., -1] += 3 * u[..., 1]
            v = v + 0.1 / SUBSTEPS * force
            x = x + 0.1 / SUBSTEPS * v
        return np.concatenate([x, v], -1), pay


def chain(rows: int, seed: int) -> tuple[EnvironmentSpec, Samples]:
    """Episodes from random starts under random actions that hold for a few steps."""
    machine, rng, steps = Chain(), np.random.default_rng(seed), []
    for _ in range(rows // EPISODE):
        q, u = rng.uniform(-1, 1, 2 * MASSES), rng.uniform(-1, 1, 2)
        for step in range(EPISODE):
            u = rng.uniform(-1, 1, 2) if step % 5 == 0 else u
            after, pay = machine.formula(q, u)
            steps.append((q, u, after, pay))
            q = after
    return machine.spec(), samples_of(steps)


def cheetah(rows: int, seed: int) -> tuple[EnvironmentSpec, Samples]:
    """Episodes from Gymnasium's starts under uniform actions that hold for two steps. The ranges of sampling are those
    of the log. The reward is Gymnasium's."""
    env: Any = gymnasium.make("HalfCheetah-v5").unwrapped
    rng, steps, u = np.random.default_rng(seed), [], np.zeros(6)
    for episode in range(rows // EPISODE):
        env.reset(seed=1_000_000 * seed + episode)
        for step in range(EPISODE):
            u = rng.uniform(-1, 1, 6) if step % 2 == 0 else u
            q = np.concatenate([env.data.qpos, env.data.qvel])
            _, pay, *_ = env.step(u)
            steps.append((q, u, np.concatenate([env.data.qpos, env.data.qvel]), pay))
    env.close()
    seen = np.array([q for q, *_ in steps])
    names = [f"{kind}{i}" for kind in ("x", "v") for i in range(9)]
    ranges = {
        n: Uniform(low=float(low), high=float(high))
        for n, low, high in zip(names, seen.min(0), seen.max(0), strict=True)
    }
    spec = EnvironmentSpec(
        environment="HalfCheetah",
        coordinates=tuple(Coordinate(name=n, kind="linear", sampling=ranges[n]) for n in names),
        observation=tuple(ObservationEntry(name=n, term=Term.linear(**{n: 1})) for n in names),
        action=BoxAction(low=(-1.0,) * 6, high=(1.0,) * 6),
        start=ranges,
        time_limit=EPISODE,
    )
    return spec, samples_of(steps)


def samples_of(steps: list[Any]) -> Samples:
    q, u, after, pay = (torch.from_numpy(np.array(part, dtype=np.float64)) for part in zip(*steps, strict=True))
    return Samples(q, u, after, pay, torch.zeros(len(q), dtype=torch.bool))


TASKS = {"chain": chain, "cheetah": cheetah}


def designed(spec: EnvironmentSpec, family: str, settings: Mapping[str, Any]) -> EnvironmentSpec:
    chosen = ModelChoice(name=family, settings=dict(settings))
    return spec.model_copy(update={"design": spec.design.model_copy(update={"model": chosen})})


def held_out(definition: EnvironmentDefinition, model: DynamicsModel, unseen: Samples) -> dict[str, Any]:
    """Errors and coverage of one step, and of ten."""
    made = model.transition(unseen.q, unseen.u, stds=True, reward_std=True)
    assert made.std is not None
    assert made.reward_std is not None
    truth = torch.cat([increments(definition, unseen), unseen.reward[:, None]], 1)
    off = model.means(unseen.q, unseen.u) - truth
    error = (off.square().mean(0).sqrt() / truth.std(0)).tolist()
    latent = torch.cat([made.std, made.reward_std[:, None]], 1)
    noise = 0.0 if (able := offers(model, LearnedNoise)) is None else latent.new_tensor(able.noise_stds)
    inside = (off.abs() <= WITHIN * (latent.square() + noise**2).sqrt()).double().mean(0)
    starts = torch.arange(0, len(unseen) - AHEAD, AHEAD)
    starts = starts[starts % EPISODE <= EPISODE - AHEAD]
    q = unseen.q[starts]
    for ahead in range(AHEAD):
        q = model.transition(q, unseen.u[starts + ahead]).q_next
    apart = (q - unseen.q_next[starts + AHEAD - 1]).square().mean(0).sqrt() / unseen.q_next.std(0)
    return {
        "error": [float(np.median(error[:-1])), max(error[:-1]), error[-1]],
        "after 10": [float(apart.median()), float(apart.max())],
        "coverage": [
            float(inside[:-1].median()),
            float(inside[:-1].min()),
            float(inside[:-1].max()),
            float(inside[-1]),
        ],
    }


def seconds_of_a_step(
    spec: EnvironmentSpec, model: DynamicsModel, lanes: int, form: Mapping[str, Any], seconds: float
) -> tuple[float, float]:
    """Medians of the calls that step a new session of this form for some seconds: by the clock, and of processor
    time."""
    port = LocalSurrogate(spec, model)
    action = np.random.default_rng(0).uniform(-1, 1, (lanes, model.definition.action.size)).astype(np.float32)
    session = port.open(OpenSession(num_envs=lanes, seed=0, **form)).id
    port.reset(session)
    taken: list[tuple[float, float]] = []
    end = time.perf_counter() + seconds
    while len(taken) < 2 * WARM_UP or time.perf_counter() < end:
        clock, busy = time.perf_counter(), time.process_time()
        port.step(session, action)
        taken.append((time.perf_counter() - clock, time.process_time() - busy))
    clock, busy = np.median(taken[WARM_UP:], axis=0)
    return float(clock), float(busy)


def rates(spec: EnvironmentSpec, model: DynamicsModel, lanes: int) -> dict[str, dict[str, float]]:
    """Environment steps a second of a session, by its form."""
    found = {}
    for name, form in FORMS.items():
        clock, busy = seconds_of_a_step(spec, model, lanes, form, SECONDS)
        found[name] = {"clock": lanes / clock, "processor": lanes / busy}
    return found


def measured(options: Any) -> dict[str, Any]:
    """One model, learned in this process."""
    family, settings = options.families[0], json.loads(options.settings)
    spec, samples = TASKS[options.task](options.rows, options.log)
    spec = designed(spec, family, settings)
    _, unseen = TASKS[options.task](HELD_OUT, options.log + 1)
    definition = definition_from_spec(spec)
    before, wall, busy = _peak(), time.perf_counter(), time.process_time()
    model = learner_of(definition.learning.model).learn(definition, samples).model
    wall, busy = time.perf_counter() - wall, time.process_time() - busy
    row = {"family": family, "settings": settings, "rows": options.rows, "seconds": wall, "processor seconds": busy}
    row |= {"peak MiB before": before, "peak MiB of the fit": _peak()}
    row |= held_out(definition, model, unseen)
    torch.set_num_threads(options.threads)
    row["steps a second"] = rates(spec, model, options.lanes)
    return row | {"peak MiB": _peak(), "structures": list(model.structures)}


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // MEBIBYTE


def show(row: Mapping[str, Any]) -> None:
    numbers = ", ".join(f"{value:.2g}" for value in row["error"])
    after = ", ".join(f"{value:.2g}" for value in row["after 10"])
    inside = ", ".join(f"{value:.2f}" for value in row["coverage"])
    speed = "; ".join(
        f"{name} {rate['clock']:,.0f} ({rate['processor']:,.0f})" for name, rate in row["steps a second"].items()
    )
    print(f"{row['family']} {row['settings']}, {row['rows']} rows: {row['seconds']:.0f} s", end=" ")
    print(f"({row['processor seconds']:.0f} s of processor time), {row['peak MiB']} MiB at most")
    print(f"  error: median, worst, reward {numbers}; after {AHEAD}: {after}; within 90 %: {inside}")
    print(f"  steps a second (of processor time): {speed}")


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--task", choices=TASKS, default="chain")
    made.add_argument("--families", nargs="*", default=["sparse_gaussian_process", "gaussian_process", "ensemble"])
    made.add_argument("--settings", default="{}", help="of the families, as JSON")
    made.add_argument("--rows", type=int, nargs="*", default=[10_000, 2_000], help="of the log")
    made.add_argument("--log", type=int, default=0, help="seed of the log; the held-out log has the next one")
    made.add_argument("--lanes", type=int, default=1_024)
    made.add_argument("--threads", type=int, default=2)
    made.add_argument("--one", action="store_true", help="learn one model in this process, and print it as JSON")
    options = started(made)
    if options.one:
        options.rows = options.rows[0]
        print(json.dumps(measured(options)))
        return
    report = []
    for rows in options.rows:
        for family in options.families:
            own = ["--one", "--task", options.task, "--families", family, "--settings", options.settings]
            own += ["--rows", str(rows), "--log", str(options.log), "--lanes", str(options.lanes)]
            own += ["--threads", str(options.threads)]
            done = subprocess.run([sys.executable, __file__, *own], check=True, stdout=subprocess.PIPE, text=True)
            report.append(json.loads(done.stdout.splitlines()[-1]))
            show(report[-1])
    write(options.out, f"sparse-{options.task}", {"models": report})


if __name__ == "__main__":
    main()
