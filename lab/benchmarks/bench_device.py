"""Steps on a GPU beside steps on the CPU: env-steps a second of one session in process, by the number of lanes.

    python lab/benchmarks/bench_device.py
    python lab/benchmarks/bench_device.py --models pendulum --lanes 1024 65536

``pendulum`` is exact processes of 50 samples. ``sparse`` and ``ensemble`` have learned a chain of nine masses, 18
coordinates, from ``--rows`` real steps (``bench_sparse.py``). Each form of a session is stepped on the CPU, with one
thread as a server does it and with all, and on the GPU. Devices take turns. A step includes the way of actions to the
device and of results back, as in a server. Without a GPU only the CPU is measured.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import bench_sparse
import numpy as np
import torch
from bench_sparse import chain, designed, seconds_of_a_step
from common import parser, started, write

from support.models import learn
from support.real_steps import random_steps
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.errors import InvalidInput
from surrogym_server.models.port import DynamicsModel
from surrogym_server.models.registry import learner_of
from surrogym_shared.spec import EnvironmentSpec

FORMS = {**bench_sparse.FORMS, "particles": {"variant": "probabilistic", "particles": 1_000}}
FAMILIES = {"sparse": "sparse_gaussian_process", "ensemble": "ensemble"}
SAMPLES, ROUNDS = 50, 5


def learned(name: str, rows: int) -> tuple[EnvironmentSpec, DynamicsModel]:
    """A specification and a model of it, on the CPU."""
    if name == "pendulum":
        spec = pendulum()
        return spec, learn(definition_from_spec(spec), random_steps(spec, SAMPLES, seed=0)).model
    spec, samples = chain(rows, 0)
    spec = designed(spec, FAMILIES[name], {})
    definition = definition_from_spec(spec)
    return spec, learner_of(definition.learning.model).learn(definition, samples).model


def compared(options: Any, name: str) -> list[dict[str, Any]]:
    spec, model = learned(name, options.rows)
    threads = sorted({1, torch.get_num_threads(), options.threads})
    places = {f"cpu, {count} threads": (model, count) for count in threads}
    if torch.cuda.is_available():
        places["gpu"] = (model.on(torch.device("cuda")), 1)
    found = []
    for form in options.forms:
        for lanes in options.lanes:
            rates: dict[str, list[float]] = {place: [] for place in places}
            try:
                for _ in range(options.rounds):
                    for place, (placed, count) in places.items():
                        torch.set_num_threads(count)
                        clock, _ = seconds_of_a_step(spec, placed, lanes, FORMS[form], options.seconds)
                        rates[place].append(lanes / clock)
            except InvalidInput as refused:
                print(f"{name}, {form}, {lanes:,} lanes: {refused}")
                continue
            row = {place: float(np.median(each)) for place, each in rates.items()}
            found.append({"model": name, "form": form, "lanes": lanes, **row})
            print(f"{name}, {form}, {lanes:,} lanes: " + "; ".join(f"{p} {each:,.0f}" for p, each in row.items()))
    return found


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--models", nargs="*", choices=["pendulum", *FAMILIES], default=["pendulum", *FAMILIES])
    made.add_argument("--forms", nargs="*", choices=FORMS, default=list(FORMS))
    made.add_argument("--lanes", nargs="*", type=int, default=[64, 1_024, 4_096])
    made.add_argument("--rows", type=int, default=2_000, help="real steps of the chain")
    made.add_argument("--threads", type=int, default=2, help="of the CPU, at most")
    made.add_argument("--rounds", type=int, default=ROUNDS)
    made.add_argument("--seconds", type=float, default=0.5, help="of each measurement")
    options = started(made)
    rows = [row for name in options.models for row in compared(options, name)]
    card = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    write(options.out, "device", {"gpu": card, "rates": rows})


if __name__ == "__main__":
    main()
