"""Whether an audit finds a bad policy of a machine that can only be reset, and leaves a good one alone.

A design learns a machine from rollouts. Two policies are learned in the model: a whole training, and an early one. Then
each is handed over as a user would: an audit beside a sampler, and whole episodes where that audit says that it left
states untested. The whole training's policy is also audited in machines of other masses. A policy is bad in a machine
where its real return is off the promise by ``OFF`` of its gain over no action. It is good in the machine as it is where
that is not so. Other masses that hardly matter are shown apart.

``.venv/bin/python lab/benchmarks/audit_resets.py --first-seed 0 --seeds 10``. What is done is kept in rows.csv in the
folder, so that the same command continues after Ctrl-C.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import gymnasium
import numpy as np
import torch
from audit_changes import copy_surrogate
from audit_power import OFF, PATIENCE_SECONDS, placed, sampling, share_of

from support.server import running_server
from surrogym_client.surrogates.waiting import wait_for_design
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_lab.reproduce.rows import read_records, write_records
from surrogym_sampler.original.episodes import RolloutEpisode
from surrogym_sampler.original.gymnasium import wrapped
from surrogym_sampler.original.loading import make
from surrogym_sampler.original.rollouts import FromReset
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    EnvironmentSpec,
    ObservationEntry,
    Term,
    Uniform,
    with_history,
)
from surrogym_trainer.evaluation.baselines import baseline, default_baseline
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, evaluate
from surrogym_trainer.policies import load_policy
from surrogym_trainer.policies.predict import Predict
from surrogym_trainer.training import TrainSettings, train
from surrogym_trainer.training.handover import AuditSettings, Handover, Subject, hand_over, judge_episodes
from surrogym_trainer.training.settings import chosen_for

SEARCH = "FASTPPO"
WHOLE, EARLY = "whole", "early"  # trainings
EARLY_STEPS = 20_000  # virtual steps of an early policy
EPISODES = 50  # of a real return
AUDITED = 3  # whole episodes of an audit, the default of ``surrogym audit --env``
MASSES = (1.0, 0.4, 2.5)  # factors of the machine's masses

Array = np.ndarray


class Machine(Protocol):
    """A machine that can only be reset. ``mass`` is a factor of its masses."""

    def __init__(self, mass: float = 1.0) -> None: ...
    def spec(self) -> EnvironmentSpec: ...
    def reset(self, *, seed: int | None = None) -> tuple[Any, dict[str, Any]]: ...
    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]: ...
    def coordinates(self, observation: Any) -> Array: ...
    def close(self) -> None: ...


class BuiltIn:
    """A built-in environment that is only reset, with attributes that are masses."""

    name: str
    masses: tuple[str, ...]

    def __init__(self, mass: float = 1.0) -> None:
        self._spec = make(self.name, access="reset").spec()
        self._env: Any = gymnasium.make(self.name).unwrapped
        for attribute in self.masses:
            setattr(self._env, attribute, mass * getattr(self._env, attribute))

    def spec(self) -> EnvironmentSpec:
        return self._spec

    def reset(self, *, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self._env.reset(seed=seed)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        observation, reward, terminated, _, info = self._env.step(action)
        return observation, reward, terminated, False, info

    def coordinates(self, observation: Any) -> Array:
        del observation
        return wrapped(self._spec, np.array(self._env.state, dtype=np.float64))

    def close(self) -> None:
        self._env.close()


class Pendulum(BuiltIn):
    name, masses = "Pendulum-v1", ("m",)


class SwingUp(BuiltIn):
    name, masses = "surrogym/CartPoleSwingUp-v0", ("masspole",)


class Acrobot(BuiltIn):
    name, masses = "Acrobot-v1", ("LINK_MASS_1", "LINK_MASS_2")


class Rotary:
    """A rotary pendulum that hangs at first: an arm is turned by a motor, a pendulum swings at its end.

    It has Coulomb friction and encoders of 512 lines, and an action takes effect one step late. No speed is measured.
    """

    DT, PARTS, LINES = 0.03, 15, 512
    ARM, LENGTH, INERTIA, BOB, TORQUE = 0.2, 0.15, 0.002, 0.1, 0.08  # m, m, kg m^2, kg, N m
    VISCOUS, DAMPING, COULOMB = 0.005, 1e-4, 0.003

    def __init__(self, mass: float = 1.0) -> None:
        self._bob, self._pipe = mass * self.BOB, deque([0.0])
        self._state = np.zeros(4)  # arm, tilt from upright, and their speeds

    def spec(self) -> EnvironmentSpec:
        plain = EnvironmentSpec(
            environment="rotary",
            coordinates=(
                Coordinate(name="arm", sampling=Uniform(low=-3, high=3)),
                Coordinate(name="tilt", kind="angle", sampling=Uniform(low=-np.pi, high=np.pi)),
            ),
            observation=(
                ObservationEntry(name="arm", term=Term.linear(arm=1)),
                ObservationEntry(name="cos tilt", term=Term.cos(tilt=1)),
                ObservationEntry(name="sin tilt", term=Term.sin(tilt=1)),
            ),
            action=BoxAction(low=(-1,), high=(1,)),
            start={"arm": Uniform(low=-0.1, high=0.1), "tilt": Uniform(low=3.04, high=3.24)},
            time_limit=200,
            query="rollout",
        )
        return with_history(plain, changes=1, actions=1, largest={"arm": 0.6, "tilt": 0.8})

    def reset(self, *, seed: int | None = None) -> tuple[Array, dict[str, Any]]:
        rng = np.random.default_rng(seed)
        self._state = np.array([rng.uniform(-0.1, 0.1), rng.uniform(3.04, 3.24), 0.0, 0.0])
        self._pipe = deque([0.0])
        return self._measured(), {}

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        self._pipe.append(float(np.clip(action, -1, 1).item()))
        torque, bob = self.TORQUE * self._pipe.popleft(), self._bob
        arm, tilt = self._state[:2]
        reward = 0.5 + 0.5 * np.cos(tilt) - 0.02 * arm**2
        for _ in range(self.PARTS):
            arm, tilt, turn, swing = self._state
            s, c = np.sin(tilt), np.cos(tilt)
            coupling, own = bob * self.ARM * self.LENGTH * c, bob * self.LENGTH**2
            inertia = np.array([[self.INERTIA + bob * self.ARM**2 + own * s**2, coupling], [coupling, own]])
            friction = self.VISCOUS * turn + self.COULOMB * np.tanh(50 * turn)
            forces = [
                torque - friction - 2 * own * s * c * swing * turn + bob * self.ARM * self.LENGTH * s * swing**2,
                own * s * c * turn**2 + 9.81 * bob * self.LENGTH * s - self.DAMPING * swing,
            ]
            faster = np.linalg.solve(inertia, forces)
            speeds = self._state[2:] + self.DT / self.PARTS * faster
            self._state = np.concatenate([self._state[:2] + self.DT / self.PARTS * speeds, speeds])
        measured = self._measured()
        return measured, float(reward), bool(abs(measured[0]) > 3), False, {}

    def coordinates(self, observation: Any) -> Array:
        return np.asarray(observation)

    def close(self) -> None:
        pass

    def _measured(self) -> Array:
        line = 2 * np.pi / self.LINES
        arm, tilt = line * np.round(self._state[:2] / line)
        return np.array([arm, (tilt + np.pi) % (2 * np.pi) - np.pi])


MACHINES: dict[str, tuple[type[Machine], int]] = {  # with the real steps of a design
    "pendulum": (Pendulum, 60),
    "swingup": (SwingUp, 260),
    "acrobot": (Acrobot, 200),
    "rotary": (Rotary, 600),
}


@dataclass(frozen=True)
class Row:
    """One policy in one machine. ``idle`` is the real return of no action, ``low`` to ``high`` the promise before."""

    machine: str
    training: str
    mass: float
    seed: int
    phase: str
    samples: int
    idle: float
    real: float
    low: float
    median: float
    high: float
    steps: int  # real steps of audits
    trusted: bool
    reason: str

    @property
    def bad(self) -> bool:
        """Whether the real return is off the promise by ``OFF`` of the larger of both gains."""
        gain = max(abs(self.real - self.idle), abs(self.median - self.idle), 1e-9)
        return abs(self.real - self.median) >= OFF * gain


def main() -> None:
    options = _options()
    torch.set_num_threads(1)
    path: Path = options.out / "rows.csv"
    rows = read_records(path, Row)
    done = {(row.machine, row.training, row.mass, row.seed) for row in rows}
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        for machine in options.machines.split(","):
            cases = [(WHOLE, mass) for mass in MASSES] + [(EARLY, 1.0)]
            left = [case for case in cases if (machine, *case, seed) not in done]
            if not left:
                continue
            kept = options.out / f"{machine}-{seed}"
            learn(machine, seed, kept)
            for row in audits(machine, seed, kept, left):
                rows.append(row)
                write_records(path, Row, rows)
                print(row, flush=True)
    print(table(rows))


def learn(machine: str, seed: int, kept: Path) -> None:
    """Learn a model and both policies, and keep the server's database and the policies."""
    if (kept / "learned.json").exists():
        return
    shutil.rmtree(kept, ignore_errors=True)
    kept.mkdir(parents=True)
    kind, budget = MACHINES[machine]
    spec = kind().spec()
    spec = spec.model_copy(update={"design": spec.design.model_copy(update={"budget": budget, "seed": seed})})
    sessions = {}
    with running_server(kept) as server, placed(server.url, spec, FromReset(kind()), keep=True) as (api, port):
        view = wait_for_design(api, port.surrogate, PATIENCE_SECONDS)
        for training in (WHOLE, EARLY):
            steps = None if training == WHOLE else EARLY_STEPS
            settings = chosen_for(view, TrainSettings(SEARCH, steps, seed=seed))
            train(port, kept / f"{training}.zip", settings)
            sessions[training] = dict(settings.judging)
        learned = {"name": port.surrogate, "sessions": sessions}
    (kept / "learned.json").write_text(json.dumps(learned))


def audits(machine: str, seed: int, kept: Path, cases: Sequence[tuple[str, float]]) -> Iterator[Row]:
    """Hand policies over in machines, each on a copy of the surrogate: a model learns from its audit."""
    learned = json.loads((kept / "learned.json").read_text())
    kind = MACHINES[machine][0]
    spec = kind().spec()
    idle = real_return(kind, 1.0, baseline(spec, default_baseline(spec), seed), seed)
    with TemporaryDirectory() as folder:
        shutil.copy(kept / "surrogym.db", folder)
        copy_surrogate(Path(folder) / "surrogym.db", len(cases))
        with running_server(Path(folder)) as server, Api(server.url) as api:
            for number, (training, mass) in enumerate(cases, start=1):
                name, policy = f"{learned['name']}-{number}", load_policy(kept / f"{training}.zip", SEARCH)
                real = real_return(kind, mass, policy, seed)
                with HttpSurrogate(server.url, name) as port:
                    view = api.surrogate(name)
                    subject = Subject(api, name, port, policy, learned["sessions"][training], idle, seed)
                    before = subject.promise()
                    found, steps = handed_over(subject, kind, mass, seed)
                    yield Row(
                        *(machine, training, mass, seed, view.phase, view.samples, idle, real),
                        *(before.low, before.median, before.high, steps, found.trusted, found.reason),
                    )


def handed_over(subject: Subject, kind: type[Machine], mass: float, seed: int) -> tuple[Handover, int]:
    """Audit a policy beside a sampler, and by whole episodes if that left states untested. Returns the last verdict,
    and the real steps of both."""
    with sampling(subject.api.url, subject.name, FromReset(kind(mass))):
        found = hand_over(subject, AuditSettings(seed=seed))
    audit = found.audit
    assert audit is not None, found.reason
    if found.trusted or not audit.passed or not audit.untested:
        return found, audit.steps
    settings = EvaluationSettings(AUDITED, first_seed=1_000 * seed)
    result = evaluate(subject.predict, lambda: RolloutEpisode(FromReset(kind(mass))), settings)
    return judge_episodes(subject, result), audit.steps + result.steps


def real_return(kind: type[Machine], mass: float, policy: Predict, seed: int) -> float:
    """Mean return of a policy in a machine, from resets."""
    settings = EvaluationSettings(EPISODES, first_seed=1_000_000 + 1_000 * seed, parallel=EPISODES)
    return float(evaluate(policy, lambda: RolloutEpisode(FromReset(kind(mass))), settings).returns.mean())


def table(rows: Sequence[Row]) -> str:
    """Bad policies that are not trusted, and good ones that are, by machine."""
    lines = [
        "| machine | policies | audits | trusted | share, 95 % interval | real steps |",
        "|---|---|---|---|---|---|",
    ]
    for machine in [*dict.fromkeys(row.machine for row in rows), "all"]:
        own = [row for row in rows if machine in (row.machine, "all")]
        lines.append(_line(machine, "bad", [row for row in own if row.bad]))
        lines.append(_line(machine, "good", [row for row in own if not row.bad and row.mass == 1]))
        lines.append(_line(machine, "harmless mass", [row for row in own if not row.bad and row.mass != 1]))
    return "\n".join(lines)


def _line(machine: str, policies: str, rows: Sequence[Row]) -> str:
    if not rows:
        return f"| {machine} | {policies} | 0 | - | - | - |"
    trusted = sum(row.trusted for row in rows)
    share, steps = share_of(trusted, len(rows), digits=0), np.mean([row.steps for row in rows])
    return f"| {machine} | {policies} | {len(rows)} | {trusted} | {share} | {steps:.0f} |"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=10, help="seeds of each machine")
    parser.add_argument("--machines", default=",".join(MACHINES), help="machines, separated by commas")
    parser.add_argument("--out", type=Path, default=Path("runs/audit-resets"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
