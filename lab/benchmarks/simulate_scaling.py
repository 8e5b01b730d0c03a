"""SIMULATION, not a measurement: which resource of a large cluster is used up first, from costs of single operations.

Each resource has a time that one operation takes it, and a number of servers that work side by side. Its use is the
rate of operations times that time, over the number of servers. Queues below full use, networks and disks are left out.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass


@dataclass(frozen=True)
class Costs:
    """Seconds of one operation. Those of the database were measured by ``bench_million.py`` with fsync off."""

    claim: float = 4.4e-3
    answer: float = 8.5e-3
    checkpoint: float = 0.8e-3  # of 16 KiB
    checkpoint_mib: float = 3.8e-3  # of each MiB more: processor time, without the disk
    renewal: float = 9.9e-3 / 500  # of one session, in one statement for 500
    host_request: float = 1.8e-3  # that the engine adds to a step of one lane
    gpu_particle: float = 1.0e-9  # ASSUMED, of one particle's step with 100 samples; it was not measured


COORDINATES = 2  # of a particle, each a double
DATABASE_CORES = 16  # ASSUMED, of PostgreSQL


@dataclass(frozen=True)
class Use:
    resource: str
    servers: int
    busy: float  # servers that are busy on average

    @property
    def share(self) -> float:
        return self.busy / self.servers


def lanes(costs: Costs, lanes: int, particles: int, gpus: int, steps: float) -> list[Use]:
    """Lanes with particles, stepped ``steps`` times a second. Each GPU has one session, recorded once a second."""
    mib = lanes * particles * COORDINATES * 8 / gpus / 2**20
    recording = costs.checkpoint + mib * costs.checkpoint_mib + costs.renewal / 2
    return [
        Use("GPUs", gpus, steps * lanes * particles * costs.gpu_particle),
        Use("session hosts, one process for each GPU", gpus, steps * gpus * costs.host_request),
        Use("front servers, 2 processes", 2, steps * gpus * costs.host_request),
        Use(f"cores of the database, checkpoints of {mib:.1f} MiB", DATABASE_CORES, gpus * recording),
    ]


def samplers(costs: Costs, samplers: int, step: float, fronts: int) -> list[Use]:
    """Samplers whose environment takes ``step`` seconds, with one query in each claim. Requests overlap with steps."""
    rate = samplers / max(step, costs.claim, costs.answer)
    return [
        Use(f"front servers, {fronts} processes", fronts, rate * (costs.claim + costs.answer)),
        Use("rows of one surrogate: answers take turns", 1, rate * costs.answer),
        Use("rows of 200 surrogates", 200, rate * costs.answer),
    ]


def sessions(costs: Costs, sessions: int, steps: float, hosts: int, fronts: int) -> list[Use]:
    """Sessions of one lane, each stepped ``steps`` times a second and recorded once a second."""
    recording = costs.checkpoint + costs.renewal / 2
    return [
        Use(f"session hosts, {hosts} processes", hosts, sessions * steps * costs.host_request / 2),
        Use(f"front servers, {fronts} processes", fronts, sessions * steps * costs.host_request / 2),
        Use("cores of the database, checkpoints and renewals", DATABASE_CORES, sessions * recording),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gpu-particle", type=float, default=Costs.gpu_particle, help="assumed seconds")
    costs = Costs(gpu_particle=parser.parse_args().gpu_particle)
    cases = {
        "10,000 lanes x 1,000 particles, 64 GPUs, 100 steps a second": lanes(costs, 10_000, 1_000, 64, 100.0),
        "1,000 samplers, environment of 1 s, 8 front servers": samplers(costs, 1_000, 1.0, 8),
        "10,000 sessions, 10 steps a second each, 64 hosts, 32 front servers": sessions(costs, 10_000, 10.0, 64, 32),
    }
    print("SIMULATION from the costs of single operations; not a measurement")
    for what, uses in cases.items():
        print(what)
        for use in sorted(uses, key=lambda use: -use.share):
            print(f"  {use.resource:56} {100 * use.share:8.1f} % of {use.servers}")


if __name__ == "__main__":
    main()
