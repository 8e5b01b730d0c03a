"""A double pendulum with one motor, at the shoulder, with dead time, friction that sticks, noise and encoders.

    surrogym doctor --env "exec:python examples/machines/double_pendulum.py --seed 1" --history 60

No speed is measured. Equations of motion: M. W. Spong, D. J. Block, "The Pendubot: a mechatronic system for control
research and education", IEEE Conference on Decision and Control, 1995. The seed draws the sizes within 15 %.
"""

import math

import numpy as np
from dirt import GRAVITY, PARTS, Dirt, Machine
from program import angle, main, specification, term

COUNTS = 4096


class DoublePendulum(Machine):
    """Angles: of the first link from hanging, and of the second from the first. Both links are slender rods."""

    name, period, seconds, largest = "double-pendulum", 0.02, 5.0, 5.0  # -, s, s, N m
    upright = (term("cos", "shoulder", -1), term("cos", "elbow"))

    def __init__(self, seed=0, clean=False):
        rng = np.random.default_rng([seed, 2])
        about = rng.uniform(0.85, 1.15, 5)
        self.lengths, self.masses = np.array([0.3, 0.25]) * about[:2], np.array([0.5, 0.4]) * about[2:4]  # m, kg
        self.damping = np.array([0.01, 0.002]) * about[4]
        dirt = Dirt(
            delay=round(PARTS * rng.uniform(0.2, 1.2)),
            limit=rng.uniform(4, 5),
            sliding=(rng.uniform(0.05, 0.12), rng.uniform(0.002, 0.006)),
            sticking=rng.uniform(1.3, 1.7),
            noise=(0.002, 0.002),
            width=(2 * math.pi / COUNTS,) * 2,
        )
        self.dirt = Dirt() if clean else dirt

    def spec(self):
        return specification(self, (angle("shoulder", (-0.1, 0.1)), angle("elbow", (-0.1, 0.1))))

    def start(self, rng):
        return rng.uniform(-0.1, 0.1, 2)

    def mass(self, q):
        (l1, l2), (m1, m2) = self.lengths, self.masses
        inner, outer, coupling = m1 * l1**2 / 3 + m2 * l1**2, m2 * l2**2 / 3, m2 * l1 * l2 / 2 * math.cos(q[1])
        return np.array([[inner + outer + 2 * coupling, outer + coupling], [outer + coupling, outer]])

    def forces(self, q, v, u):
        (l1, l2), (m1, m2) = self.lengths, self.masses
        turning = m2 * l1 * l2 / 2 * math.sin(q[1])
        heavy = m2 * GRAVITY * l2 / 2 * math.sin(q[0] + q[1])
        shoulder = u + turning * (2 * v[0] * v[1] + v[1] ** 2) - (m1 / 2 + m2) * GRAVITY * l1 * math.sin(q[0]) - heavy
        return np.array([shoulder, -turning * v[0] ** 2 - heavy]) - self.damping * v

    def energy(self, q, v):
        (l1, l2), (m1, m2) = self.lengths, self.masses
        height = -(m1 / 2 + m2) * l1 * math.cos(q[0]) - m2 * l2 / 2 * math.cos(q[0] + q[1])
        return 0.5 * v @ self.mass(q) @ v + GRAVITY * height

    def reward(self, read):
        l1, l2 = self.lengths
        return 0.5 - 0.5 * (l1 * math.cos(read[0]) + l2 * math.cos(read[0] + read[1])) / (l1 + l2)

    def ended(self, read):
        return False


if __name__ == "__main__":
    main(DoublePendulum)
