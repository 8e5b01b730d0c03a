"""Whether audits find wrong models, and leave right ones alone: false alarms and power, with exact intervals.

A sampler beside a machine answers the queries of a design. For a wrong model the machine is another one meanwhile: a
term is missing, a sign is turned, a sensor's zero has moved; or it has too few samples. A policy is learned in the
model. Then the real machine is back, the policy is handed over with an audit, and its real return is measured. A model
is wrong where its promise is off by ``OFF`` of the range from the return of no action to the best that right models led
to.

``make audit-power`` runs 100 right models and 200 that may be wrong, in about an hour of two cores. What is done
is kept in rows.csv in the folder, so that the same command goes on after Ctrl-C.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from uuid import uuid4

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch

from support.changing import FEW, MACHINES, RIGHT, Changing, Machine, parameters_of
from support.server import running_server
from surrogym_client.errors import UnknownSurrogate
from surrogym_client.runtime.versions import commit
from surrogym_client.surrogates.waiting import wait_for_design
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_lab.reproduce.rows import read_records, write_records
from surrogym_lab.reproduce.statistics import exact_interval
from surrogym_sampler.original.protocol import Environment
from surrogym_sampler.queries import Sampler, SamplerSettings
from surrogym_shared.spec import Design, EnvironmentSpec
from surrogym_trainer.policies import load_policy
from surrogym_trainer.training import TrainSettings, train
from surrogym_trainer.training.handover import AuditSettings, Handover, Subject, hand_over
from surrogym_trainer.training.settings import chosen_for

OFF = 0.2  # of the range of returns
PATIENCE_SECONDS = 600.0
SEARCH = {"population": 16, "starts": 6, "units": 4}  # of CMA-ES
GENERATIONS = 10
STARTS = 100  # of a real return


@dataclass(frozen=True)
class Row:
    """One audit. ``idle`` is the real return without any action, ``promise`` the median before the audit."""

    machine: str
    mechanism: str
    seed: int
    strength: float
    samples: int
    phase: str
    idle: float
    real: float
    promise: float
    passed: bool
    trusted: bool
    kept: bool  # the real return is at least the 5 % quantile of the promise that was handed over
    fault: str
    commit: str


def main() -> None:
    options = _options()
    torch.set_num_threads(1)
    path: Path = options.out / "rows.csv"
    rows = read_records(path, Row)
    done = {(row.machine, row.mechanism, row.seed) for row in rows}
    with TemporaryDirectory() as folder, running_server(Path(folder)) as server:
        for machine, mechanism, seed in cases(options.first_seed, options.right, options.wrong):
            if (machine.name, mechanism, seed) in done:
                continue
            rows.append(audited(server.url, machine, mechanism, seed, Path(folder)))
            write_records(path, Row, rows)
            print(rows[-1], flush=True)
    print(table(rows))


def cases(first_seed: int, right: int, wrong: int) -> Iterator[tuple[Machine, str, int]]:
    """Every machine with ``right`` seeds as it is, and with ``wrong`` seeds by each mechanism."""
    for seed in range(first_seed, first_seed + max(right, wrong)):
        for machine in MACHINES:
            mechanisms = [RIGHT] * (seed < first_seed + right and machine.best is None)
            mechanisms += [*machine.wrong, FEW] * (seed < first_seed + wrong)
            yield from product([machine], mechanisms, [seed])


def audited(url: str, machine: Machine, mechanism: str, seed: int, folder: Path) -> Row:
    """Learn a model and a policy, and audit it."""
    rng = np.random.default_rng([seed, *mechanism.encode()])
    strength = float(rng.uniform())
    design = Design(initial=machine.budget // 3, budget=machine.budget, seed=seed)
    if mechanism == FEW:
        count = int(rng.integers(*machine.few, endpoint=True))
        design = Design(initial=count, budget=count, seed=seed)
    spec = machine.spec.model_copy(update={"design": design})
    environment = Changing(machine, parameters_of(machine, mechanism, strength), rng)
    with placed(url, spec, environment) as (api, port):
        view = wait_for_design(api, port.surrogate, PATIENCE_SECONDS)
        steps = GENERATIONS * SEARCH["population"] * SEARCH["starts"] * machine.time_limit
        settings = chosen_for(view, TrainSettings("CMAES", steps, seed=seed, hyperparameters=dict(SEARCH)))
        policy = load_policy(train(port, folder / "policy.zip", settings).path, "CMAES")
        environment.parameters = machine.real
        real = float(machine.returns(policy, STARTS, seed).mean())
        idle = float(machine.returns(lambda o: np.zeros((len(o), machine.actions)), STARTS, seed).mean())
        subject = Subject(api, port.surrogate, port, policy, dict(settings.judging), idle, seed)
        handover = hand_over(subject, AuditSettings(seed=seed))
    return _row(handover, machine.name, mechanism, seed, strength, view.samples, view.phase, idle, real)


def _row(handover: Handover, *known: str | int | float) -> Row:
    audit, real = handover.audit, float(known[-1])
    assert audit is not None, handover.reason
    fault = audit.faults[0] if audit.faults else ""
    kept = real >= handover.promise.low
    return Row(*known, audit.before.median, audit.passed, handover.trusted, kept, fault, commit())  # type: ignore[arg-type]


@contextmanager
def placed(
    url: str, spec: EnvironmentSpec, environment: Environment, *, keep: bool = False
) -> Iterator[tuple[Api, HttpSurrogate]]:
    """A surrogate, with a sampler beside the environment in a thread. It is deleted at the end, or kept."""
    name = f"audited-{uuid4().hex[:8]}"
    with Api(url) as api, HttpSurrogate(url, name) as port:
        api.create_surrogate(name, spec)
        with sampling(url, name, environment):
            try:
                yield api, port
            finally:
                if not keep:
                    api.delete_surrogate(name)


@contextmanager
def sampling(url: str, name: str, environment: Environment) -> Iterator[None]:
    """A connected sampler beside the environment in a thread, until the context ends or the surrogate is deleted."""
    settings = SamplerSettings(name="beside", wait_seconds=0.5, time_limit=2 * PATIENCE_SECONDS)
    with Api(url) as own:
        sampler = Sampler(own, name, environment, settings)
        thread = threading.Thread(target=_until_deleted, args=(sampler,))
        thread.start()
        try:
            while not own.surrogate(name).samplers:
                time.sleep(0.05)
            yield
        finally:
            sampler.stop()
            thread.join()


def _until_deleted(sampler: Sampler) -> None:
    with suppress(UnknownSurrogate):
        sampler.run()


def offs(rows: Sequence[Row]) -> list[float]:
    """How far each promise is off, of its machine's range."""
    best = {machine.name: machine.best for machine in MACHINES}
    for row in rows:
        if row.mechanism == RIGHT:
            best[row.machine] = max(row.real, best[row.machine] or row.real)
    ranges = [(best[row.machine] or row.real) - row.idle for row in rows]
    return [abs(row.real - row.promise) / max(span, 1e-9) for row, span in zip(rows, ranges, strict=True)]


def table(rows: Sequence[Row]) -> str:
    """Failed audits of right models, and of wrong ones by mechanism and by how far they are off."""
    lines = ["| models | off by | audits | failed | share, 95 % interval |", "|---|---|---|---|---|"]
    found = list(zip(rows, offs(rows), strict=True))
    right = [row for row, off in found if row.mechanism == RIGHT and off < OFF]
    wrong = [(row, off) for row, off in found if row.mechanism != RIGHT and off >= OFF]
    lines.append(_line("right", f"below {OFF:.0%}", right))
    lines += [
        _line(mechanism, f"{OFF:.0%} or more", [row for row, _ in wrong if row.mechanism == mechanism])
        for mechanism in dict.fromkeys(row.mechanism for row, _ in wrong)
    ]
    lines.append(_line("wrong, all", f"{OFF:.0%} or more", [row for row, _ in wrong]))
    lines.append(_line("wrong, all", f"{OFF:.0%} to {2 * OFF:.0%}", [row for row, off in wrong if off < 2 * OFF]))
    apart = [row for row, off in found if row.mechanism == RIGHT and off >= OFF]
    lines.append(_line("of the machine as it is", f"{OFF:.0%} or more", apart))
    trusted = [row for row, _ in found if row.trusted]
    share = share_of(sum(row.kept for row in trusted), len(trusted))
    return "\n".join(lines) + f"\n\nreal return above the 5 % quantile of the promise: {share} of all trusted"


def _line(models: str, off: str, rows: Sequence[Row]) -> str:
    failed = sum(not row.passed for row in rows)
    return f"| {models} | {off} | {len(rows)} | {failed} | {share_of(failed, len(rows))} |"


def share_of(count: int, of: int, digits: int = 1) -> str:
    """A share in per cent with its exact 95 % interval."""
    if not of:
        return "-"
    low, high = exact_interval(count, of)
    return f"{100 * count / of:.{digits}f} % ({100 * low:.{digits}f} to {100 * high:.{digits}f})"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--right", type=int, default=20, help="seeds of each machine as it is")
    parser.add_argument("--wrong", type=int, default=9, help="seeds of each machine and mechanism")
    parser.add_argument("--out", type=Path, default=Path("runs/audit-power"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
