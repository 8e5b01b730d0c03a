"""A log of 2,000 noisy rows, four levels and two pumps: seconds until there is a model, and of 100,000 virtual steps.

python lab/benchmarks/bench_noisy_log.py --rows 2000 --seeds 0 1 2

Each seed makes a log of its own: a quadruple tank (Johansson 2000) whose pumps change at random every five steps, and
whose sensors have a noise of 0.3 mm. A training is timed in the model, and its predictions are compared with the next
levels of a further log, in parts of the sensors' noise: a model can't be better than 1.41, the noise of two readings.
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from bench_start import serving
from common import parser, started, write

from surrogym_client.surrogates.waiting import wait_for_model
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_sampler.logs import import_log
from surrogym_trainer.training import TrainSettings, train
from surrogym_trainer.training.settings import chosen_for

PATIENCE, NOISE, PERIOD, PARTS, HELD = 3_600.0, 0.03, 5.0, 10, 5  # s, cm, s, Euler steps, steps of one action
SECTION, OUTLET = np.array([28, 32, 28, 32.0]), np.array([0.071, 0.057, 0.071, 0.057])  # cm^2
PUMP, SHARE, GRAVITY = np.array([3.33, 3.35]), np.array([0.7, 0.6]), 981.0
NAMES = ("h1", "h2", "h3", "h4")

Array = np.ndarray


def operate(rows: int, seed: int, inset: float = 0.0) -> tuple[Array, Array]:
    """Readings (rows + 1, 4) in cm, and voltages (rows + 1, 2), which keep an inset from 0 and 6 V."""
    rng, h, u = np.random.default_rng(seed), np.array([10, 10, 5, 5.0]), np.zeros(2)
    readings, voltages = [], []
    for number in range(rows + 1):
        if number % HELD == 0:
            u = rng.uniform(inset, 6 - inset, 2)
        readings.append(h + NOISE * rng.standard_normal(4))
        voltages.append(u)
        for _ in range(PARTS):
            out, own, beyond = OUTLET * np.sqrt(2 * GRAVITY * h), SHARE * PUMP * u, (1 - SHARE) * PUMP * u
            into = np.array([out[2] + own[0], out[3] + own[1], beyond[1], beyond[0]])
            h = np.clip(h + PERIOD / PARTS * (into - out) / SECTION, 0, 40)
    return np.array(readings), np.array(voltages)


def save(path: Path, readings: Array, voltages: Array) -> None:
    """Write a log whose reward is quadratic in the distance of the lower levels from 12 cm."""
    rewards = -0.01 * np.square(readings[:, :2] - 12).sum(1)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time", *NAMES, "action_1", "action_2", "reward"])
        for number, (h, u, reward) in enumerate(zip(readings, voltages, rewards, strict=True)):
            writer.writerow([PERIOD * number, *(f"{value:.5g}" for value in (*h, *u, reward))])


def run(rows: int, steps: int, seed: int) -> dict[str, Any]:
    """One log: its model, and a training in it."""
    with TemporaryDirectory() as place, serving(Path(place)) as url, Api(url) as api:
        folder = Path(place)
        save(folder / "log.csv", *operate(rows, seed))
        begun = time.perf_counter()
        import_log(folder / "log.csv", register="tanks", url=url)
        view = wait_for_model(api, "tanks", PATIENCE)
        known = time.perf_counter() - begun
        readings, voltages = operate(500, seed + 1_000_000, inset=0.1)
        predicted = api.predict("tanks", readings[:-1].tolist(), voltages[:-1].tolist()).next_coordinates
        off = np.sqrt(np.square(predicted - readings[1:]).mean(0)) / NOISE
        size = len(api.export_model("tanks", view.model_version or 1))
        begun = time.perf_counter()
        with HttpSurrogate(url, "tanks") as port:
            result = train(port, folder / "policy.zip", chosen_for(view, TrainSettings(seed=seed, total_steps=steps)))
        trained = time.perf_counter() - begun
    seconds = {"seconds to a model": known, "seconds of training": trained, "virtual steps": result.virtual_steps}
    return {"seed": seed, **seconds, "error": np.round(off, 3).tolist(), "bytes": size}


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    made.add_argument("--rows", type=int, default=2_000)
    made.add_argument("--steps", type=int, default=100_000, help="virtual steps of each training")
    options: argparse.Namespace = started(made)
    rows = []
    for seed in options.seeds:
        rows.append(run(options.rows, options.steps, seed))
        print(rows[-1], flush=True)
    write(options.out, "noisy_log", {"rows": rows})


if __name__ == "__main__":
    main()
