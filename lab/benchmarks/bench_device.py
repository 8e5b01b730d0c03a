"""Steps on a GPU beside steps on the CPU: env-steps a second of one session in process, by the number of lanes.

    python lab/benchmarks/bench_device.py
    python lab/benchmarks/bench_device.py --models pendulum --lanes 1024 65536
    python lab/benchmarks/bench_device.py --table

``pendulum`` is exact processes of 50 samples. ``sparse`` and ``ensemble`` have learned a chain of nine masses, 18
coordinates, from ``--rows`` real steps (``bench_sparse.py``). Each form of a session is stepped on the CPU, with one
thread as a server does it and with all, and on the GPU. Devices take turns. A step includes the way of actions to the
device and of results back, as in a server. Without a GPU only the CPU is measured.

``--table`` takes the figures of lab/records/results/gpu.md, in some five minutes on a machine with a GPU: its loads,
up to a million lanes, each beside its matrix products alone and the copies of its actions and results alone, and what
a profile of its steps shows: how long the GPU is busy, kernels, copies, and how often the program waits for it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import bench_sparse
import numpy as np
import torch
from bench_predict import products
from bench_sparse import chain, designed, seconds_of_a_step
from common import Call, parser, started, write

from support.models import learn
from support.real_steps import random_steps
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.errors import InvalidInput
from surrogym_server.models.port import DynamicsModel
from surrogym_server.models.registry import learner_of
from surrogym_server.tensors import CPU, fetched, sent
from surrogym_server.virtual import VirtualSettings, create, in_fastest_form, reset, step
from surrogym_shared.spec import EnvironmentSpec

FORMS = {**bench_sparse.FORMS, "particles": {"variant": "probabilistic", "particles": 1_000}}
FAMILIES = {"sparse": "sparse_gaussian_process", "ensemble": "ensemble"}
SAMPLES, ROUNDS = 50, 5
# What --table measures: a form of sessions, the numbers of their lanes, and of those with --quick.
LOADS: tuple[tuple[str, tuple[int, ...], int], ...] = (
    ("mean", (1_024, 65_536, 1_048_576), 1_024),
    ("function", (1_024, 16_384), 64),
    ("particles", (256, 1_024), 2),
)
WARM_UP, LEAST = 3, 5  # calls that are not measured, and of those that are


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


def table(options: Any) -> list[dict[str, Any]]:
    """The loads of ``LOADS``, stepped as a session does it, beside parts of the work alone. Milliseconds a step."""
    _, model = learned("pendulum", options.rows)
    there = model.on(torch.device("cuda")) if torch.cuda.is_available() else model
    found = []
    for form, counts, few in LOADS:
        for lanes in (few,) if options.quick else counts:
            subjects = {f"cpu, {count} threads": (model, count) for count in sorted({1, options.threads})}
            calls: dict[str, tuple[Call, int]] = {
                name: (stepping(placed, form, lanes), count) for name, (placed, count) in subjects.items()
            }
            if there is not model:
                calls["gpu"] = stepping(there, form, lanes), 1
            rows = lanes * FORMS[form].get("particles", 1)
            calls["its products alone"] = products_of(there, form, rows), 1
            calls["its copies alone"] = copies(there, lanes), 1
            row: dict[str, Any] = {"form": form, "lanes": lanes}
            for name, (call, count) in calls.items():
                torch.set_num_threads(count)
                row[name] = 1e3 * seconds_of(call, options.seconds)
            torch.set_num_threads(1)
            if "gpu" in calls:
                row["profile"] = profiled(calls["gpu"][0])
            found.append(row)
            print(f"{form}, {lanes:,} lanes")
            for name in calls:
                print(f"  {name}: {row[name]:.3f} ms, {1e3 * lanes / row[name]:,.0f} env-steps/s")
            for name, value in row.get("profile", {}).items():
                print(f"  {name}: {value}")
    return found


def stepping(model: DynamicsModel, form: str, lanes: int) -> Call:
    """Steps of a session, one after the other."""
    limit = model.definition.time_limit
    chosen = VirtualSettings(lanes, autoreset_mode="same_step", time_limit=limit, **FORMS[form])
    settings = in_fastest_form(chosen, model)
    state, _ = reset(model.definition, settings, create(model.definition, settings, 0))
    u = np.random.default_rng(0).uniform(-1, 1, (lanes, model.definition.action.size))

    def call() -> None:
        nonlocal state
        state, _ = step(model, settings, state, u)

    return call


def products_of(model: Any, form: str, rows: int) -> Call:
    """The matrix products of a step, and with functions those of their weights."""
    stages = [group for group in model._predictor._groups if group]
    wanted = form == "particles"
    calls = [products(s.serving, rows, list(s.serving.processes) if wanted else []) for s in stages]
    if form == "function":
        weights = torch.rand(rows, model.path_size, dtype=torch.float64, device=model.definition.device)
        calls.append(lambda: torch.linalg.vecdot(weights, weights))
    return on_device(model, lambda: [call() for call in calls])


def copies(model: DynamicsModel, lanes: int) -> Call:
    """Actions to the device; observation, reward and two flags back."""
    device, size = model.definition.device, len(model.definition.observation_names)
    u = np.zeros((lanes, model.definition.action.size))
    results = torch.zeros(lanes, 4 * size + 8 + 2, dtype=torch.uint8, device=device)
    return on_device(model, lambda: (sent(u, device), fetched(results)))


def on_device(model: DynamicsModel, call: Callable[[], Any]) -> Call:
    """A call that ends when the device has done it."""

    def done() -> None:
        call()
        if model.definition.device != CPU:
            torch.cuda.synchronize()

    return done


def seconds_of(call: Call, seconds: float) -> float:
    """Median duration of a call in seconds. It is called for ``seconds``, and at least ``LEAST`` times."""
    for _ in range(WARM_UP):
        call()
    taken, end = [], time.perf_counter() + seconds
    while len(taken) < LEAST or time.perf_counter() < end:
        began = time.perf_counter()
        call()
        taken.append(time.perf_counter() - began)
    return float(np.median(taken))


def profiled(call: Call, calls: int = 5) -> dict[str, Any]:
    """What a step does on the GPU, and the kernels that take the most of it."""
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profile:
        for _ in range(calls):
            call()
        torch.cuda.synchronize()
    events = [e for e in profile.events() if e.device_type == torch.autograd.DeviceType.CUDA]
    copied = [e for e in events if e.name.startswith("Memcpy")]
    waits = [e for e in profile.events() if e.name.startswith(("cudaStreamSync", "cudaDeviceSync", "cudaEventSync"))]
    named: dict[str, float] = {}
    for event in events:
        named[event.name] = named.get(event.name, 0.0) + event.device_time / 1e3 / calls
    longest = sorted(named.items(), key=lambda item: -item[1])[:8]
    return {
        "busy, ms": sum(named.values()),
        "kernels": (len(events) - len(copied)) / calls,
        "copies": len(copied) / calls,
        "waits": (len(waits) - 1) / calls,
        "longest, ms": {name[:60]: round(value, 4) for name, value in longest},
    }


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--models", nargs="*", choices=["pendulum", *FAMILIES], default=["pendulum", *FAMILIES])
    made.add_argument("--forms", nargs="*", choices=FORMS, default=list(FORMS))
    made.add_argument("--lanes", nargs="*", type=int, default=[64, 1_024, 4_096])
    made.add_argument("--rows", type=int, default=2_000, help="real steps of the chain")
    made.add_argument("--threads", type=int, default=2, help="of the CPU, at most")
    made.add_argument("--rounds", type=int, default=ROUNDS)
    made.add_argument("--seconds", type=float, default=0.5, help="of each measurement")
    made.add_argument("--table", action="store_true", help="the figures of lab/records/results/gpu.md")
    options = started(made)
    if options.table:
        write(options.out, "device-table", {"gpu": card(), "loads": table(options)})
        return
    rows = [row for name in options.models for row in compared(options, name)]
    write(options.out, "device", {"gpu": card(), "rates": rows})


def card() -> str | None:
    return torch.cuda.get_device_name() if torch.cuda.is_available() else None


if __name__ == "__main__":
    main()
