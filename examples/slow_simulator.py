"""A slow simulator, and four samplers that share its queries.

surrogym register slow_simulator:SlowPendulum --name slow
python slow_simulator.py slow

A step takes two seconds, or SIMULATOR_SECONDS. Samplers may as well run on four machines, with a licence each.
"""

import os
import subprocess
import sys
import time

from surrogym_sampler.original.loading import make

SAMPLERS = 4
SECONDS = float(os.environ.get("SIMULATOR_SECONDS", "2"))


class SlowPendulum:
    """Stands for a simulator that meshes, solves and reads a file for every step."""

    def __init__(self):
        self.simulator = make("Pendulum-v1")

    def spec(self):
        return self.simulator.spec()

    def step_from(self, coordinates, action):
        time.sleep(SECONDS)
        return self.simulator.step_from(coordinates, action)

    def close(self):
        self.simulator.close()


def main(surrogate: str) -> int:
    """Runs the samplers until the design is done; each claims one query at a time, so that none waits for another's."""
    command = ["surrogym", "sample", surrogate, "--env", "slow_simulator:SlowPendulum", "--batch", "1", "--until-done"]
    started = time.monotonic()
    samplers = [subprocess.Popen([*command, "--worker", f"simulator-{i}"]) for i in range(SAMPLERS)]
    failed = sum(sampler.wait() != 0 for sampler in samplers)
    print(f"{SAMPLERS} samplers, {failed} failed, {time.monotonic() - started:.1f} s")
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
