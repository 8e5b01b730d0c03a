"""Whether an audit notices that a plant has changed, and leaves the same plant unchanged alone.

A design learns a plant from textbook physics (``support.levitation``), a policy is learned in the model, and both are
kept. Then the plant changes: mass, pump, friction, a step of delay, a sensor's offset. In each changed plant, and twice
in the unchanged one, a copy of the surrogate audits the same policy, and the policy's real return is measured there. A
change is harmful where the policy loses a fifth or more of its gain over no action.

``.venv/bin/python lab/benchmarks/audit_changes.py --first-seed 0 --seeds 3`` takes about three minutes a plant and
seed. What is done is kept in rows.csv in the folder, so that the same command goes on after Ctrl-C.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch
from audit_power import PATIENCE_SECONDS, SEARCH, placed, sampling

from support.changing import Machine
from support.levitation import PLANTS, Plant, real_returns
from support.server import running_server
from surrogym_client.surrogates.waiting import wait_for_design
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_lab.reproduce.statistics import exact_interval
from surrogym_shared.spec import Design
from surrogym_trainer.policies import load_policy
from surrogym_trainer.training import TrainSettings, train
from surrogym_trainer.training.handover import AuditSettings, Subject, hand_over
from surrogym_trainer.training.settings import chosen_for

HARMFUL = 0.2  # share of the policy's gain
EPISODES = 100  # of a real return
GENERATIONS = 12
UNCHANGED = ("unchanged", "unchanged again")


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

    @property
    def lost(self) -> float:
        return (self.real - self.now) / max(self.real - self.idle, 1e-9)


def main() -> None:
    options = _options()
    torch.set_num_threads(1)
    path: Path = options.out / "rows.csv"
    rows = _read(path)
    done = {(row.plant, row.change, row.seed) for row in rows}
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        for machine in PLANTS:
            if options.plant not in ("", machine.name):
                continue
            kept = options.out / f"{machine.name}-{seed}"
            learn(machine, seed, kept)
            for change in [*UNCHANGED, *machine.wrong] if not options.learn_only else ():
                if (machine.name, change, seed) not in done:
                    rows.append(audited(machine, change, seed, kept))
                    _write(path, rows)
                    print(rows[-1], flush=True)
    print(table(rows))


def learn(machine: Machine, seed: int, kept: Path) -> None:
    """Learn a model and a policy of the unchanged plant, and keep the server's database and the policy."""
    if (kept / "learned.json").exists():
        return
    shutil.rmtree(kept, ignore_errors=True)
    kept.mkdir(parents=True)
    design = Design(initial=machine.budget // 3, budget=machine.budget, seed=seed)
    spec = machine.spec.model_copy(update={"design": design})
    plant = Plant(machine, machine.real, np.random.default_rng([seed, 1]))
    with running_server(kept) as server, placed(server.url, spec, plant, keep=True) as (api, port):
        view = wait_for_design(api, port.surrogate, PATIENCE_SECONDS)
        steps = GENERATIONS * SEARCH["population"] * SEARCH["starts"] * machine.time_limit
        settings = chosen_for(view, TrainSettings("CMAES", steps, seed=seed, hyperparameters=dict(SEARCH)))
        train(port, kept / "policy.zip", settings)
        learned = {"name": port.surrogate, "session": dict(settings.judging)}
    (kept / "learned.json").write_text(json.dumps(learned))


def audited(machine: Machine, change: str, seed: int, kept: Path) -> Row:
    """Audit the policy in a plant that has changed, on a copy of the surrogate."""
    number = [*UNCHANGED, *machine.wrong].index(change)
    parameters = {**machine.real, **(machine.wrong[change](0.0) if change in machine.wrong else {})}
    learned = json.loads((kept / "learned.json").read_text())
    policy = load_policy(kept / "policy.zip", "CMAES")
    idle = real_returns(machine, machine.real, lambda o: np.zeros((len(o), machine.actions)), EPISODES, seed)[0]
    real, now = (real_returns(machine, p, policy, EPISODES, seed)[0].mean() for p in (machine.real, parameters))
    plant = Plant(machine, parameters, np.random.default_rng([seed, 2, number]))
    with TemporaryDirectory() as folder:
        shutil.copy(kept / "surrogym.db", folder)
        with (
            running_server(
                Path(folder), SURROGYM_COMPILED="0"
            ) as server,  # a copy is audited once, which takes no compiling
            Api(server.url) as api,
            HttpSurrogate(server.url, learned["name"]) as port,
            sampling(server.url, learned["name"], plant),
        ):
            phase = api.surrogate(learned["name"]).phase
            subject = Subject(api, learned["name"], port, policy, learned["session"], float(idle.mean()), seed)
            found = hand_over(subject, AuditSettings(seed=seed + 1_000 * number))
    audit, promise = found.audit, found.promise
    assert audit is not None, found.reason
    assert promise is not None
    before = audit.before
    numbers = (float(idle.mean()), float(real), float(now), before.low, before.high, promise.low, promise.high)
    return Row(machine.name, change, seed, phase, *numbers, audit.steps, found.trusted, found.reason)


def table(rows: Sequence[Row]) -> str:
    """Policies that lost trust, by plant: in harmful changes, in the unchanged plant, and in harmless changes."""
    lines = ["| plant | audits | runs | untrusted | share, 95 % interval | steps |", "|---|---|---|---|---|---|"]
    for plant in [*dict.fromkeys(row.plant for row in rows), "all"]:
        own = [row for row in rows if plant in (row.plant, "all")]
        same = [row for row in own if row.change in UNCHANGED]
        changed = [row for row in own if row.change not in UNCHANGED]
        lines.append(_line(plant, "harmful change", [row for row in changed if row.lost >= HARMFUL]))
        lines.append(_line(plant, "unchanged", same))
        lines.append(_line(plant, "harmless change", [row for row in changed if row.lost < HARMFUL]))
    return "\n".join(lines)


def _line(plant: str, what: str, rows: Sequence[Row]) -> str:
    if not rows:
        return f"| {plant} | {what} | 0 | - | - | - |"
    lost = sum(not row.trusted for row in rows)
    low, high = exact_interval(lost, len(rows))
    share = f"{100 * lost / len(rows):.0f} % ({100 * low:.0f} to {100 * high:.0f})"
    return f"| {plant} | {what} | {len(rows)} | {lost} | {share} | {np.mean([row.steps for row in rows]):.1f} |"


def _read(path: Path) -> list[Row]:
    if not path.exists():
        return []
    kinds = {"str": str, "int": int, "float": float, "bool": lambda text: text == "True"}
    of = {field.name: kinds[str(field.type)] for field in fields(Row)}
    with path.open(encoding="utf-8", newline="") as lines:
        return [Row(**{name: of[name](text) for name, text in line.items()}) for line in csv.DictReader(lines)]


def _write(path: Path, rows: Sequence[Row]) -> None:
    with path.open("w", encoding="utf-8", newline="") as lines:
        writer = csv.DictWriter(lines, [field.name for field in fields(Row)])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


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
