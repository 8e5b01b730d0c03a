"""Whether queries go where a plant differs from its prior: a driven hinge beside a simulator that lacks something.

    python lab/benchmarks/bench_difference.py --kind magnet stiff --seeds 11 12 13 14 15 16

The simulator is ``tests/support/hinge.py``. The plant has a magnet, which accelerates it by 3 rad/s^2 times
exp(-((angle - 1.5) / 0.4)^2), or Coulomb friction. Each design begins with eight steps. Each seed has two rows: as it
is, and with reference points that do not weigh the difference. ``near`` is the number of adaptive queries within 0.8
rad of the magnet, a quarter of the range; ``beyond`` is the share of 400 random steps whose speed is predicted with an
error beyond the tolerance, near the magnet and elsewhere.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch

import surrogym
from support.hinge import PERIOD, Textbook, hinge_spec, steps_of
from surrogym_server.models.gaussian_process.prediction import lookahead

TOLERANCE = 0.05  # of the standard deviation of the changes of speed
PLACE, NEAR, TESTS = 1.5, 0.8, 400


class Magnet(Textbook):
    """A hinge with a magnet."""

    def step_from(self, coordinates: np.ndarray, action: np.ndarray) -> surrogym.RealStep:
        step = super().step_from(coordinates, action)
        more = PERIOD * 3 * math.exp(-(((float(coordinates[0]) - PLACE) / 0.4) ** 2))
        angle, speed = step.next_coordinates
        turned = (angle + PERIOD * more + math.pi) % (2 * math.pi) - math.pi
        return replace(step, next_coordinates=(turned, speed + more))


class Stiff(Textbook):
    """A hinge with Coulomb friction."""

    def more(self, speed: float) -> float:
        return -1.5 * math.tanh(4 * speed)


PLANTS = {"magnet": Magnet, "stiff": Stiff}


def main() -> None:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--kind", nargs="+", choices=PLANTS, default=list(PLANTS))
    made.add_argument("--seeds", nargs="+", type=int, required=True)
    options = made.parse_args()
    torch.set_num_threads(1)
    own = lookahead.DIFFERENCE
    for kind in options.kind:
        for seed in options.seeds:
            for lookahead.DIFFERENCE in (own, 0.0):
                print(kind, seed, "as it is" if lookahead.DIFFERENCE else "unweighted", run(kind, seed), flush=True)


def run(kind: str, seed: int) -> str:
    plant, spec = PLANTS[kind](), hinge_spec(design={"budget": 40, "initial": 8, "seed": seed})
    design, near = surrogym.Design(spec, prior=surrogym.Prior(Textbook(), spec, steps=100)), 0
    while (query := design.ask()) is not None:
        near += query.purpose == "adaptive" and abs(query.coordinates[0] - PLACE) < NEAR
        design.tell(query, plant.step_from(np.array(query.coordinates), np.array(query.action)))
    test = steps_of(plant, TESTS, 999)
    q, u, after = (np.array([getattr(s, f) for s in test]) for f in ("coordinates", "action", "next_coordinates"))
    found = design.surrogate().model.transition(torch.from_numpy(q), torch.from_numpy(u)).q_next.numpy()
    beyond = np.abs(found - after)[:, 1] > TOLERANCE * (after - q)[:, 1].std()
    by_magnet = np.abs(q[:, 0] - PLACE) < NEAR
    shares = f"beyond {beyond[by_magnet].mean():.3f} and {beyond[~by_magnet].mean():.3f}"
    return f"{design.phase} after {design.steps}, near {near} of {design.steps - 8}, {shares}"


if __name__ == "__main__":
    main()
