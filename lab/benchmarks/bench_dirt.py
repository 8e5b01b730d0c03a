"""Whether the dirt of a machine is named from 60 real steps, one kind at a time on the cart-pole swing-up.

    python lab/benchmarks/bench_dirt.py --first-seed 100 --seeds 20

The swing-up (PILCO's, moved by ``examples/machines/dirt.py``, only reset) has sizes that each seed draws within 15 %.
A row counts as right if the kind of dirt is named with its size and no other kind is: a dead time within 0.2 of a step,
widths of encoders within 1 %, noise of at least half of the coordinates, each named deviation within a factor of 1.5.
``clean`` is a dead time of 0. ``no speeds`` hides both speeds: one earlier change is needed.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / "machines"))

import numpy as np
from dirt import PARTS, Dirt, Machine

from surrogym_sampler.diagnosis.taking import take
from surrogym_sampler.original.swingup import GRAVITY, swing_up
from surrogym_shared.dirt import Dirt as Found
from surrogym_shared.dirt import identify, sensors
from surrogym_shared.nouns import RealStep
from surrogym_shared.spec import EnvironmentSpec, limits

STEPS = 60
WITHIN = 0.2  # steps of a dead time
FACTOR = 1.5  # of a standard deviation
COUNTS, PULLEY = 2048, 0.2  # counts of a turn, m of belt in a turn
POSITIONS = ("x", "angle")


class SwingUp(Machine):
    """A rod hangs from a cart. Joints: position of the cart, and angle from hanging; sensors: as in ``swing_up``."""

    period = 0.1

    def __init__(self, seed: int, dirt: Dirt) -> None:
        about = np.random.default_rng([seed, 9]).uniform(0.85, 1.15, 4)
        self.cart, self.pole, self.length, self.friction = np.array([0.5, 0.5, 0.6, 0.1]) * about
        self.dirt = dirt

    def start(self, rng: np.random.Generator) -> np.ndarray:
        return rng.uniform(-0.1, 0.1, 2)

    def reset(self, seed: int | None = None) -> np.ndarray:
        super().reset(seed)
        self.v = self._rng.uniform(-0.1, 0.1, 2)
        return self.measured()

    def sensed(self) -> np.ndarray:
        return np.array([self.q[0], self.v[0], self.q[1], self.v[1]])

    def mass(self, q: np.ndarray) -> np.ndarray:
        coupling = self.pole * self.length / 2 * math.cos(q[1])
        return np.array([[self.cart + self.pole, coupling], [coupling, self.pole * self.length**2 / 3]])

    def forces(self, q: np.ndarray, v: np.ndarray, u: float) -> np.ndarray:
        moment, s = self.pole * self.length / 2, math.sin(q[1])
        return np.array([u - self.friction * v[0] + moment * s * v[1] ** 2, -moment * GRAVITY * s])


class Reset:
    """A swing-up as an environment that answers rollouts."""

    def __init__(self, machine: SwingUp, spec: EnvironmentSpec) -> None:
        self.machine, self._spec = machine, spec
        self._columns = [swing_up().coordinate_names.index(name) for name in spec.coordinate_names]

    def spec(self) -> EnvironmentSpec:
        return self._spec

    def begin(self, seed: int | None = None) -> np.ndarray:
        self.at = self._read(self.machine.reset(seed))
        return self.at

    def act(self, action: np.ndarray) -> RealStep:
        before, self.at = self.at, self._read(self.machine.step(float(action[0])))
        return RealStep(before, action, self.at, 0.0)

    def close(self) -> None:
        pass

    def _read(self, measured: np.ndarray) -> np.ndarray:
        measured[2] = (measured[2] + math.pi) % (2 * math.pi) - math.pi
        return measured[self._columns]


def dirt_of(kind: str, seed: int) -> Dirt:
    what, _, size = kind.partition(" ")
    spans = [high - low for low, high in (limits(c.sampling) for c in swing_up().coordinates)]
    match what:
        case "delay":
            return Dirt(delay=round(PARTS * float(size)))
        case "noise":
            return Dirt(noise=tuple(0.01 * float(size) * span for span in spans))
        case "encoder":
            return Dirt(width=(PULLEY / COUNTS, 0.0, 2 * math.pi / COUNTS, 0.0))
        case "stiction":
            rng = np.random.default_rng([seed, 4])
            return Dirt(sliding=(rng.uniform(0.7, 1.3), 0.0), sticking=rng.uniform(1.3, 1.7))
    return Dirt()


KINDS = ("clean", "delay 1", "delay 2.5", "noise 1", "noise 3", "encoder", "stiction", "no speeds")


def named(kind: str, seed: int) -> Found:
    """What is found in the swing-up with one kind of dirt."""
    spec = swing_up().model_copy(update={"query": "rollout"})
    if kind == "no speeds":
        own = tuple(c for c in spec.coordinates if c.name in POSITIONS)
        spec = spec.model_copy(update={"coordinates": own})
    return identify(take(Reset(SwingUp(seed, dirt_of(kind, seed)), spec), spec, STEPS, seed), sensors(spec))


def right(kind: str, seed: int, found: Found) -> bool:
    """Whether the kind of dirt was named with its size, and no other."""
    true = dirt_of(kind, seed)
    kinds = {
        "delay": found.delay is not None,
        "noise": bool(found.noise),
        "encoder": bool(found.encoders),
        "stiction": bool(found.stiction),
        "no": found.explained is not None and found.explained.changes > 0,
    }
    what = kind.partition(" ")[0]
    if [name for name, was in kinds.items() if was] != [name for name in kinds if name == what]:
        return False
    names = swing_up().coordinate_names
    match what:
        case "delay":
            assert found.delay is not None
            return abs(found.delay.steps - true.delay / PARTS) <= WITHIN + 1e-9
        case "noise":
            off = [noise.std / true.noise[names.index(name)] for name, noise in found.noise.items()]
            return 2 * len(off) >= len(names) and all(1 / FACTOR <= ratio <= FACTOR for ratio in off)
        case "encoder":
            widths = {name: true.width[names.index(name)] for name in POSITIONS}
            close = [abs(found.encoders.get(name, 0.0) / width - 1) < 0.01 for name, width in widths.items()]
            return len(found.encoders) == len(widths) and all(close)
        case "stiction":
            return set(found.stiction) == {"x"}
        case "no":
            return found.explained is not None and found.explained.changes == 1
    return True


def words(found: Found) -> str:
    past = found.explained.changes if found.explained else None
    delay = f"{found.delay.steps:.1f} ({found.delay.odds:.0f})" if found.delay else "-"
    noise = {name: f"{noise.std:.3g}" for name, noise in found.noise.items()}
    stuck = {name: one.steps for name, one in found.stiction.items()}
    widths = {name: f"{width:.3g}" for name, width in found.encoders.items()}
    return f"changes {past}, delay {delay}, encoders {widths}, stiction {stuck}, noise {noise}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    options = parser.parse_args()
    lines = []
    for kind in options.kinds:
        good, began = 0, time.process_time()
        for seed in range(options.first_seed, options.first_seed + options.seeds):
            found = named(kind, seed)
            good += (is_right := right(kind, seed, found))
            print(f"{kind}, seed {seed}: {'right' if is_right else 'WRONG'}; {words(found)}", flush=True)
        seconds = (time.process_time() - began) / options.seeds
        lines.append(f"| {kind} | {good} of {options.seeds} | {seconds:.1f} |")
    print("\n".join(["| kind | named rightly | CPU s |", "|---|---|---|", *lines]))


if __name__ == "__main__":
    main()
