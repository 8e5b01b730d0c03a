# ruff: noqa: E402
"""Steps of a surrogate's FMU beside those of the served model and of the plant: python bench_twin.py [PLANT ...]

The plants are the FMUs of examples/fmus; they need pythonfmu and a C compiler. Differences are of single steps from the
same state: of coordinates in their unit, and of deviations in the output's deviation over the samples.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "examples" / "fmus"), str(ROOT / "tests")]

import control
from fmpy.validation import validate_fmu

import surrogym
from support.twins import OpenFmu, opened
from surrogym_sampler import original
from surrogym_sampler.original.describing import describe
from surrogym_server.deployment import write_twin
from surrogym_server.local import LocalSurrogate
from surrogym_server.models.port import DynamicsModel
from surrogym_shared.spec import DeclaredReward, EnvironmentSpec
from surrogym_shared.wire import OpenSession

BUDGET, EPISODES, STEPS = 30, 100, 100


def designed(name: str, folder: Path) -> tuple[Path, EnvironmentSpec, Path]:
    """The plant's FMU, its specification, and the file of a surrogate that a design learned."""
    plant = control.built(name, folder)
    terms, start = control.GOALS[name]
    reward = DeclaredReward(kind="declared", timing="after", terms=terms)
    spec = describe(f"fmu:{plant}").spec.model_copy(update={"reward": reward, "start": start})
    machine = original.make(f"fmu:{plant}", spec=spec, budget=BUDGET, seed=0)
    design = surrogym.Design(machine.spec())
    while (query := design.ask()) is not None:
        design.tell(query, machine.step_from(np.array(query.coordinates), np.array(query.action)))
    machine.close()
    design.save(folder / f"{name}.surrogate", name)
    print(f"{name}: {design.steps} real steps")
    return plant, spec, folder / f"{name}.surrogate"


def driven(one: OpenFmu, spec: EnvironmentSpec, shown: list[str], start: np.ndarray, u: np.ndarray) -> np.ndarray:
    """States before, and what is shown after each action u (T,)."""
    names, rows = spec.coordinate_names, []
    one.fmu.reset()
    one.begin(dict(zip(names, start.tolist(), strict=True)))
    before = one.get(*names)
    for count, value in enumerate(u):
        one.step(count * spec.sampling_period, spec.sampling_period, action=float(value))
        after = one.get(*names, *shown)
        rows.append([*before, *after])
        before = after[: len(names)]
    return np.array(rows)


def compared(model: DynamicsModel, rows: np.ndarray, u: np.ndarray) -> tuple[float, float]:
    """Largest differences of coordinates, and of deviations, between single steps of the FMU and of the model."""
    size, outputs = len(model.definition.coordinates), len(model.definition.outputs) - 1
    moved = model.transition(torch.from_numpy(rows[:, :size].copy()), torch.from_numpy(u[:, None]), stds=True)
    assert moved.std is not None
    stds = (rows[:, 2 * size : 2 * size + outputs] - moved.std.numpy()) / model.scales[:-1].numpy()
    return np.abs(rows[:, size : 2 * size] - moved.q_next.numpy()).max(), np.abs(stds).max()


def main() -> None:
    for name in sys.argv[1:] or control.SCRIPTS:
        with tempfile.TemporaryDirectory() as folder:
            plant, spec, file = designed(name, Path(folder))
            began = time.perf_counter()
            twin = write_twin(file.read_bytes(), Path(folder, "twin.fmu"))
            print(f"  written and compiled in {time.perf_counter() - began:.1f} s, {twin.bytes:,} bytes")
            print(f"  fmpy validate: {validate_fmu(str(twin.path)) or 'no problems'}")
            local, rng = LocalSurrogate.from_file(file), np.random.default_rng(0)
            low, high = spec.action.low[0], spec.action.high[0]
            shown = [f"deviation.{output}" for output in local.model.definition.outputs[:-1]]
            rows, actions, errors, worst = [], [], [], 0.0
            with opened(twin.path) as one:
                seconds = 0.0
                for _ in range(EPISODES):
                    begin = np.array(
                        [rng.uniform(spec.start[n].low, spec.start[n].high) for n in spec.coordinate_names]
                    )
                    u = np.clip(np.cumsum(rng.normal(0, 0.1 * (high - low), STEPS)) + (low + high) / 2, low, high)
                    began = time.perf_counter()
                    rows.append(driven(one, spec, shown, begin, u))
                    seconds += time.perf_counter() - began
                    actions.append(u)
            state, std = compared(local.model, np.concatenate(rows), np.concatenate(actions))
            print(f"  {EPISODES * STEPS} steps: coordinates differ by {state:.1e}, deviations by {std:.1e}")
            print(f"  {1e6 * seconds / EPISODES / STEPS:.0f} µs a step and its values through fmpy")
            machine = original.make(f"fmu:{plant}", spec=spec)
            ranges = [[getattr(c.sampling, end) for c in spec.coordinates] for end in ("low", "high")]
            print(f"  sampling range {ranges}")
            try:
                for row, u in zip(rows[:10], actions[:10], strict=True):
                    size = len(spec.coordinates)
                    real = np.array(
                        [
                            machine.step_from(r[:size], np.array([a])).next_coordinates
                            for r, a in zip(row, u, strict=True)
                        ]
                    )
                    known = ((row[:, :size] >= ranges[0]) & (row[:, :size] <= ranges[1])).all(1)
                    off = np.abs(real - row[:, size : 2 * size])[known]
                    errors.append(off / np.maximum(row[known, 2 * size : 3 * size], 1e-12))
                    worst = np.maximum(worst, off.max(0, initial=0.0))
            finally:
                machine.close()
            within = 100 * (np.concatenate(errors) < 2).mean()
            count = sum(map(len, errors))
            print(f"  {count} steps of the plant in its range: at most {worst} away, {within:.0f} % within 2 sd")
            session = local.open(OpenSession(num_envs=1)).id
            local.reset(session, seed=0)
            began = time.perf_counter()
            for value in actions[0]:
                local.step(session, np.array([[value]]), deviations=True)
            print(f"  {1e6 * (time.perf_counter() - began) / STEPS:.0f} µs a step of one lane in Python")


if __name__ == "__main__":
    main()
