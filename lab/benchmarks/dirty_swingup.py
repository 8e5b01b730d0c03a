"""The cart-pole swing-up with one kind of dirt, as a program that can only be reset (docs/how-to/executables.md).

    python lab/benchmarks/dirty_swingup.py --kind "noise 3" --seed 5

The physics and the kinds are those of ``bench_dirt.py``. Rewards are those of the state itself; noise and encoders
change what is read, not what is earned.
"""

from __future__ import annotations

import argparse
import math
from typing import Any

from bench_dirt import KINDS, SwingUp, dirt_of  # also makes examples/machines importable
from program import serve

from surrogym_sampler.original.swingup import WIDTH, swing_up
from surrogym_shared.spec import EnvironmentSpec

HELD = 20  # last steps of an episode in which the rod must be up
UP = -0.95  # cosine of an angle from hanging, below which the rod is up


class DirtySwingUp(SwingUp):
    """The swing-up as a machine of the protocol, which also counts for how many last steps the rod was up."""

    def __init__(self, kind: str, seed: int) -> None:
        super().__init__(seed, dirt_of(kind, seed))
        self.held = 0

    def spec(self) -> dict[str, Any]:
        own = swing_up().model_copy(update={"query": "rollout", "environment": "swingup"})
        # with noise, what is read says little of whether the rod is up
        return own.model_copy(update={"success": None} if self.dirt.noise else {}).model_dump(mode="json")

    def reset(self, seed: int | None = None) -> Any:
        self.held = 0
        return super().reset(seed)

    def measured(self) -> Any:
        read = super().measured()
        read[2] = (read[2] + math.pi) % (2 * math.pi) - math.pi
        return read

    def step(self, action: float) -> Any:
        read = super().step(action)
        self.held = self.held + 1 if math.cos(self.q[1]) < UP else 0
        return read

    def reward(self, read: Any) -> float:
        del read
        x, angle = self.q
        across, above = x + self.length * math.sin(angle), -self.length * math.cos(angle) - self.length
        return math.exp(-(across**2 + above**2) / (2 * WIDTH["smooth"] ** 2))

    def ended(self, read: Any) -> bool:
        del read
        return False


class InProcess:
    """A dirty swing-up in this process. ``ups`` gets an entry for each episode that ended: whether the rod was up."""

    def __init__(self, kind: str, seed: int, spec: EnvironmentSpec) -> None:
        self.machine, self._spec = DirtySwingUp(kind, seed), spec
        self.ups: list[bool] = []

    def spec(self) -> EnvironmentSpec:
        return self._spec

    def reset(self, *, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        self.taken = 0
        return self.machine.reset(seed), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        read = self.machine.step(float(action[0]))
        self.taken += 1
        if self.taken == swing_up().time_limit:
            self.ups.append(self.machine.held >= HELD)
        return read, self.machine.reward(read), False, False, {}

    def coordinates(self, observation: Any) -> Any:
        return observation

    def close(self) -> None:
        pass


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", choices=KINDS, default="clean")
    parser.add_argument("--seed", type=int, default=0, help="draws the parameters of the machine")
    options = parser.parse_args()
    serve(DirtySwingUp(options.kind, options.seed))


if __name__ == "__main__":
    main()
