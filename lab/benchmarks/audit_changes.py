"""Whether an audit notices that a plant has changed, and leaves the same plant unchanged alone.

A design learns a plant from textbook physics (``support.levitation``), a policy is learned in the model, and both are
kept. Then the plant changes: mass, pump, friction, a step of delay, a sensor's offset. The policy's real return is
measured in each changed plant. A change is harmful where the policy loses a fifth or more of its gain over no action.
In each of these, and four times in the unchanged plant, a copy of the surrogate audits the policy.

``.venv/bin/python lab/benchmarks/audit_changes.py --first-seed 0 --seeds 3`` takes about three minutes a plant and
seed. What is done is kept in rows.csv in the folder, so that the same command continues after Ctrl-C.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sqlite3
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch
from audit_power import PATIENCE_SECONDS, placed, sampling, share_of

from support.changing import Machine, Parameters
from support.levitation import PLANTS, Plant, real_returns
from support.server import running_server
from surrogym_client.surrogates.waiting import wait_for_design
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_lab.reproduce.rows import read_records, write_records
from surrogym_shared.spec import Design
from surrogym_trainer.policies import load_policy
from surrogym_trainer.policies.evidence import Promise
from surrogym_trainer.policies.predict import Predict
from surrogym_trainer.training import TrainSettings, train
from surrogym_trainer.training.handover import AuditSettings, Subject, hand_over
from surrogym_trainer.training.settings import chosen_for

HARMFUL = 0.2  # share of the policy's gain
EPISODES = 100  # of a real return
SEARCH = "FASTPPO"
APART = 1_000_000  # between the numbers of two copies in a database
UNCHANGED = ("unchanged", "unchanged 2", "unchanged 3", "unchanged 4")


@dataclass(frozen=True)
class Row:
    """One audit. ``idle`` and ``real`` are real returns in the audited plant and without a change."""

    plant: str
    change: str
    seed: int
    phase: str
    idle: float  # of no action in the unchanged plant
    real: float  # of the policy in the unchanged plant
    now: float  # of the policy in the audited plant
    low: float  # of the promise before the audit
    high: float
    promised_low: float  # of the promise that was handed over
    promised_high: float
    steps: int
    trusted: bool
    reason: str


def main() -> None:
    options = _options()
    torch.set_num_threads(1)
    path: Path = options.out / "rows.csv"
    rows = read_records(path, Row)
    done = {(row.plant, row.change, row.seed) for row in rows}
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        for machine in PLANTS:
            if options.plant not in ("", machine.name):
                continue
            kept = options.out / f"{machine.name}-{seed}"
            learn(machine, seed, kept)
            left = worth_auditing(machine, seed, kept)
            left = {change: returns for change, returns in left.items() if (machine.name, change, seed) not in done}
            for row in audits(machine, seed, kept, left) if left and not options.learn_only else ():
                rows.append(row)
                write_records(path, Row, rows)
                print(row, flush=True)
    print(table(rows))


def learn(machine: Machine, seed: int, kept: Path) -> None:
    """Learn a model and a policy of the unchanged plant, and keep the server's database and the policy."""
    if (kept / "learned.json").exists():
        return
    shutil.rmtree(kept, ignore_errors=True)
    kept.mkdir(parents=True)
    design = Design(initial=machine.budget, budget=machine.budget, seed=seed)  # in one round: one fit instead of many
    spec = machine.spec.model_copy(update={"design": design})
    plant = Plant(machine, machine.real, np.random.default_rng([seed, 1]))
    with running_server(kept) as server, placed(server.url, spec, plant, keep=True) as (api, port):
        view = wait_for_design(api, port.surrogate, PATIENCE_SECONDS)
        settings = chosen_for(view, TrainSettings(SEARCH, seed=seed))
        train(port, kept / "policy.zip", settings)
        learned = {"name": port.surrogate, "session": dict(settings.judging)}
    (kept / "learned.json").write_text(json.dumps(learned))


class Returns(NamedTuple):
    """Real mean returns: of no action and of the policy in the unchanged plant, and of the policy in a changed one."""

    idle: float
    real: float
    now: float

    @property
    def lost(self) -> float:
        """Share of the policy's gain that the change costs."""
        return (self.real - self.now) / max(self.real - self.idle, 1e-9)


def worth_auditing(machine: Machine, seed: int, kept: Path) -> dict[str, Returns]:
    """The unchanged plant, and the changes that are harmful, with the real returns."""
    policy = load_policy(kept / "policy.zip", SEARCH)

    def mean(parameters: Parameters, predict: Predict) -> float:
        return float(real_returns(machine, parameters, predict, EPISODES, seed)[0].mean())

    idle = mean(machine.real, lambda o: np.zeros((len(o), machine.actions)))
    real = mean(machine.real, policy)
    found = {change: Returns(idle, real, real) for change in UNCHANGED}
    for change in machine.wrong:
        returns = Returns(idle, real, mean(changed(machine, change), policy))
        print(machine.name, seed, change, f"{returns.lost:.0%} lost", flush=True)
        if returns.lost >= HARMFUL:
            found[change] = returns
    return found


def changed(machine: Machine, change: str) -> dict[str, float]:
    """Parameters of the audited plant."""
    return {**machine.real, **(machine.wrong[change](0.0) if change in machine.wrong else {})}


def audits(machine: Machine, seed: int, kept: Path, wanted: Mapping[str, Returns]) -> Iterator[Row]:
    """Audit the policy in plants, each on a copy of the surrogate: a model learns from its audit."""
    learned = json.loads((kept / "learned.json").read_text())
    policy = load_policy(kept / "policy.zip", SEARCH)
    with TemporaryDirectory() as folder:
        shutil.copy(kept / "surrogym.db", folder)
        copy_surrogate(Path(folder) / "surrogym.db", len(wanted))
        with running_server(Path(folder)) as server, Api(server.url) as api:
            before = None  # the same for all copies, so it is computed once
            for number, (change, returns) in enumerate(wanted.items(), start=1):
                name = f"{learned['name']}-{number}"
                with HttpSurrogate(server.url, name) as port:
                    subject = Promised(api, name, port, policy, learned["session"], returns.idle, seed)
                    before = before or subject.promise()
                    yield audited(machine, change, replace(subject, before=[before]), returns)


@dataclass(frozen=True)
class Promised(Subject):
    """A policy whose first promises are known: those of ``before``, the first one last."""

    before: list[Promise] = field(default_factory=list)

    def promise(self) -> Promise:
        return self.before.pop() if self.before else super().promise()


def copy_surrogate(database: Path, count: int) -> None:
    """Copy the only surrogate of a database that no server uses: its name with -1 to -count."""
    with closing(sqlite3.connect(database)) as connection, connection:
        for table in ("surrogates", "models", "queries", "leases", "samples"):
            columns = [name for _, name, *_ in connection.execute(f"PRAGMA table_info({table})")]
            for number in range(1, count + 1):
                values = [
                    f"{name} + {APART * number}"
                    if name in ("id", "surrogate_id", "query_id", "lease_id")
                    else f"{name} || '-{number}'"
                    if (table, name) in (("surrogates", "name"), ("leases", "token"))
                    else name
                    for name in columns
                ]
                query = f"INSERT INTO {table} SELECT {', '.join(values)} FROM {table}"
                connection.execute(f"{query} WHERE {'id' if table == 'surrogates' else 'surrogate_id'} < {APART}")


def audited(machine: Machine, change: str, subject: Subject, returns: Returns) -> Row:
    """Audit the policy in one plant."""
    number, seed = [*UNCHANGED, *machine.wrong].index(change), subject.seed
    plant = Plant(machine, changed(machine, change), np.random.default_rng([seed, 2, number]))
    with sampling(subject.api.url, subject.name, plant):
        phase = subject.api.surrogate(subject.name).phase
        found = hand_over(subject, AuditSettings(seed=seed + 1_000 * number))
    audit, promise = found.audit, found.promise
    assert audit is not None, found.reason
    assert promise is not None
    promised = (audit.before.low, audit.before.high, promise.low, promise.high)
    return Row(machine.name, change, seed, phase, *returns, *promised, audit.steps, found.trusted, found.reason)


def table(rows: Sequence[Row]) -> str:
    """Policies that lost trust, by plant: in harmful changes, and in the unchanged plant.

    A promise is broken where the policy's real return is below the interval that was handed over.
    """
    lines = [
        "| plant | audits | runs | untrusted | share, 95 % interval | trusted, and broken | steps |",
        "|---|---|---|---|---|---|---|",
    ]
    for plant in [*dict.fromkeys(row.plant for row in rows), "all"]:
        own = [row for row in rows if plant in (row.plant, "all")]
        lines.append(_line(plant, "harmful change", [row for row in own if row.change not in UNCHANGED]))
        lines.append(_line(plant, "unchanged", [row for row in own if row.change in UNCHANGED]))
    return "\n".join(lines)


def _line(plant: str, what: str, rows: Sequence[Row]) -> str:
    if not rows:
        return f"| {plant} | {what} | 0 | - | - | - | - |"
    lost = sum(not row.trusted for row in rows)
    broken = sum(row.trusted and row.now < row.promised_low for row in rows)
    share = share_of(lost, len(rows), digits=0)
    steps = np.mean([row.steps for row in rows])
    return f"| {plant} | {what} | {len(rows)} | {lost} | {share} | {broken} | {steps:.1f} |"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=3, help="seeds of each plant")
    parser.add_argument("--plant", default="", help="only this plant")
    parser.add_argument("--learn-only", action="store_true", help="learn the policies and audit nothing")
    parser.add_argument("--out", type=Path, default=Path("runs/audit-changes"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
