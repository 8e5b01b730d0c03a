"""From a cold machine that can only be reset to a policy: real steps, return, success and promise, by the commands that
a person gives.

Each run starts a server and a sampler, registers the machine within a budget of real steps, and runs
``surrogym train``: it makes a planner, or policies that try episodes with what the design leaves of the budget. A
policy that is not trusted then is audited with whole episodes. It is evaluated in real episodes, from which nothing is
learned. Tasks of the demo are machines, too. Those of ``examples/machines`` are programs whose seed draws the
parameters; their lags are those that ``surrogym doctor --history 60`` proposes, with larger ranges. Prints one line for
each run, and appends it to ``trials.csv``; a run that is there is not repeated.

    python lab/benchmarks/bench_trials.py --seeds 200 201 202 203 204 --machines belt furuta
    python lab/benchmarks/bench_trials.py --seeds 200 201 202 203 204 --machines pendulum acrobot
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from common import OUT, append_row
from dirty_swingup import InProcess

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np

from support.server import running_server
from surrogym.demo.tasks import TASKS
from surrogym_client.transport import Api
from surrogym_sampler import original
from surrogym_sampler.original.episodes import RolloutEpisode
from surrogym_sampler.original.rollouts import answering
from surrogym_shared.limits import past
from surrogym_shared.spec import EnvironmentSpec, Limit, Limits, Term, with_history
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, evaluate
from surrogym_trainer.policies import load_policy

ROOT = Path(__file__).parents[2]
MINUTES = 60.0  # longest time of one command
PATIENT_SECONDS = 5.0  # without an action for this time, the fallback of limits acts


@dataclass(frozen=True)
class Machine:
    """A machine, and the budget of its design and trials.

    Attributes:
        name: environment, as ``--env`` names it; ``{seed}`` is the seed that draws its parameters.
        budget: largest number of real steps without audits.
        changes: number of earlier changes of a coordinate that are declared.
        actions: number of earlier actions that are declared.
        largest: largest change of each coordinate in one step.
        limits: limits that hold from the first real step on.
        stop: largest absolute value of the first coordinate, by which episodes with and without limits are judged.
    """

    name: str
    budget: int
    changes: int = 0
    actions: int = 0
    largest: tuple[float, ...] = ()
    limits: Limits | None = None
    stop: float | None = None


def _program(name: str, folder: str = "examples/machines") -> str:
    return f"exec:{sys.executable} {ROOT}/{folder}/{name}.py --seed {{seed}}"


def _swing_up(kind: str, actions: int = 0) -> Machine:
    """A swing-up with a dead time and 1.5 times the real steps that a clean one needs (``bench_resets.py``)."""
    return Machine(f"{_program('dirty_swingup', 'lab/benchmarks')} --kind '{kind}'", 150, 0, actions)


# dead times of the swing-up, and the earlier actions that each needs as coordinates
SWING_UPS = {"delay 1": 1, "delay 2.5": 3}


# The arm's angle, and the way of six steps with the present speed. Chosen on seeds 50 to 52, where the arm itself stays
# within 1.8 rad under random actions.
STOPS = Limits(
    keep=(Limit(name="stop", term=Term.linear(**{"arm": 1, "arm.change1": 6}), low=-2.8, high=2.8, margin=1.6),),
    fallback=(Term.linear(**{"arm": -6, "arm.change1": -60}),),
)

MACHINES = {
    "belt": Machine(_program("belt"), 450, 2, 1, (0.12, 0.6)),
    "furuta": Machine(_program("furuta"), 400, 1, 2, (0.6, 0.8), stop=1.8),
    "furuta-limits": Machine(_program("furuta"), 400, 1, 2, (0.6, 0.8), STOPS, stop=1.8),
    "double_pendulum": Machine(_program("double_pendulum"), 600, 1, 2, (0.6, 0.9)),
    "invertedpendulum2": Machine("InvertedDoublePendulum-v5", 120),
    "reacher": Machine("Reacher-v5", 200),
    **{f"swingup-{kind.replace(' ', '-')}": _swing_up(kind, actions) for kind, actions in SWING_UPS.items()},
    "swingup-noise-1": _swing_up("noise 1"),
}
# tasks of the demo, and their largest number of real steps without audits
BUDGETS = {
    "pendulum": 18,
    "cartpole": 26,
    "mountaincar": 130,
    "swingup": 75,
    "swingup-narrow": 100,
    "acrobot": 100,
    "invertedpendulum": 30,
}
CLEAN = {task: Machine(TASKS[task].environment, budget) for task, budget in BUDGETS.items()}


def main() -> None:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--machines", nargs="+", default=tuple(MACHINES), choices=(*MACHINES, *CLEAN))
    made.add_argument("--seeds", nargs="+", type=int, required=True)
    made.add_argument("--budget", type=int, help="largest number of real steps, instead of the machine's")
    made.add_argument("--episodes", type=int, default=100)
    made.add_argument("--out", type=Path, default=OUT)
    options = made.parse_args()
    file = options.out / "trials.csv"
    done = set()
    if file.exists():
        with file.open(newline="", encoding="utf-8") as rows:
            done = {(row["machine"], int(row["seed"])) for row in csv.DictReader(rows)}
    for seed in options.seeds:
        for machine in options.machines:
            if (machine, seed) not in done:
                with TemporaryDirectory() as folder:
                    row = _run(machine, seed, options.budget, options.episodes, Path(folder))
                print(json.dumps(row), flush=True)
                append_row(file, row)


def _run(machine: str, seed: int, budget: int | None, episodes: int, folder: Path) -> dict[str, Any]:
    made, begun = (MACHINES | CLEAN)[machine], time.monotonic()
    name, spec = made.name.format(seed=seed), folder / "spec.json"
    spec.write_text(specification(made, name, seed, budget or made.budget).model_dump_json())
    policy = folder / "policy.zip"
    with running_server(folder) as server:
        environment = {**os.environ, "SURROGYM_URL": server.url}

        def surrogym(*arguments: str) -> dict[str, Any]:
            line = [sys.executable, "-m", "surrogym", *arguments, "--json", "--quiet"]
            ran = subprocess.run(
                line, env=environment, timeout=60 * MINUTES, check=True, stdout=subprocess.PIPE, text=True
            )
            result: dict[str, Any] = json.loads(ran.stdout)
            return result

        where = ("--env", name, "--spec", str(spec))
        surrogym("register", name, "--spec", str(spec), "--name", machine)
        with _sampling([sys.executable, "-m", "surrogym", "sample", machine, *where], environment):
            trained = surrogym(
                "train", machine, "--wait", f"{60 * MINUTES:.0f}", "--seed", str(seed), "--out", str(policy)
            )
        # As the reason says then: one rollout from a reset left states untested, which whole episodes test.
        audited = trained if trained["trusted"] else surrogym("audit", str(policy), *where)
        minutes = (time.monotonic() - begun) / 60
        with Api(server.url) as api:
            view = api.surrogate(machine)
            trials = [len(query.actions) for query in api.queries(machine) if query.policy and query.purpose != "audit"]
            reached = np.array([sample.next_coordinates for sample in api.samples(machine)])
            left = 0 if view.spec.limits is None else int(past(view.spec, reached).sum())
        found = surrogym("evaluate", str(policy), *where, "--episodes", str(episodes))
    if machine.startswith("swingup-") and machine in MACHINES:
        found["success_rate"] = _upright(
            machine.removeprefix("swingup-").replace("-", " "), seed, policy, spec, episodes
        )
    promise = audited.get("promise") or {}
    return {
        "machine": machine,
        "seed": seed,
        "steps": view.ledger.total,
        "trials": len(trials),
        "audit": view.ledger.audit + view.ledger.evaluation,
        "resets": view.ledger.resets,
        "virtual_steps": trained["virtual_steps"],
        "minutes": round(minutes, 1),
        "mean": round(found["mean"], 2),
        "least": round(found["min"], 2),
        "success": found.get("success_rate"),
        "low": promise.get("low"),
        "high": promise.get("high"),
        "trusted": audited.get("trusted"),
        "left": left,
        "violations": found.get("limits", {}).get("violations"),
        "fallback_episodes": found.get("limits", {}).get("fallback_episodes"),
    }


def _upright(kind: str, seed: int, policy: Path, spec: Path, episodes: int) -> float:
    """Return the share of episodes in which the rod itself, not what is read of it, is up at the end."""
    machine = InProcess(kind, seed, EnvironmentSpec.model_validate_json(spec.read_text()))
    evaluate(load_policy(policy), lambda: RolloutEpisode(answering(machine)), EvaluationSettings(episodes))
    return sum(machine.ups) / len(machine.ups)


def specification(machine: Machine, name: str, seed: int, budget: int) -> EnvironmentSpec:
    plain = original.make(name, access="reset")
    spec = plain.spec()
    plain.close()
    if machine.changes or machine.actions:
        largest = dict(zip([c.name for c in spec.coordinates] if machine.changes else (), machine.largest, strict=True))
        spec = with_history(spec, changes=machine.changes, actions=machine.actions, largest=largest)
    if machine.limits is not None:
        # a busy computer may answer late, and a simulated machine does not move meanwhile
        changes = {"limits": machine.limits.model_dump(), "sampling_period": PATIENT_SECONDS}
        spec = EnvironmentSpec.model_validate({**spec.model_dump(), **changes})
    return spec.model_copy(update={"design": spec.design.model_copy(update={"budget": budget, "seed": seed})})


@contextmanager
def _sampling(line: list[str], environment: dict[str, str]) -> Iterator[None]:
    sampler = subprocess.Popen(line, env=environment, stdout=subprocess.DEVNULL)
    try:
        yield
    finally:
        sampler.send_signal(signal.SIGTERM)
        sampler.wait(60)


if __name__ == "__main__":
    main()
