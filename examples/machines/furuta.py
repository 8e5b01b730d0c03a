"""A rotary (Furuta) pendulum with encoders, a late and limited motor, and friction that sticks; no speed is measured.

    surrogym doctor --env "exec:python examples/machines/furuta.py --seed 1" --history 60

A motor turns an arm, and a rod swings at the arm's end. Equations of motion: B. S. Cazzolato, Z. Prime, "On the
dynamics of the Furuta pendulum", Journal of Control Science and Engineering, 2011, with a slender rod. Sizes are near
those of laboratory devices, and the seed draws them within 15 %.
"""

import math

import numpy as np
from dirt import GRAVITY, Dirt, Machine
from program import angle, coordinate, main, specification, term

COUNTS = 2048


class Furuta(Machine):
    name, period, seconds, largest = "furuta", 0.02, 5.0, 8.0  # -, s, s, V
    upright = (term("cos", "tilt"),)

    def __init__(self, seed=0, clean=False):
        rng = np.random.default_rng([seed, 1])
        about = rng.uniform(0.85, 1.15, 6)
        self.arm, length, self.rod = 0.085 * about[0], 0.129 * about[1], 0.024 * about[2]  # m, m, kg
        self.centre, self.inertia = length / 2, self.rod * length**2 / 3  # of the rod about its pivot
        self.arm_inertia, self.pull = 2.3e-4 * about[3], 0.005 * about[4]  # kg m2, N m per V
        self.damping = np.array([2.1e-4, 1e-5]) * about[5]  # the motor's counter-voltage, and the bearing
        width = 2 * math.pi / COUNTS
        dirt = Dirt(
            delay=10,  # 10 ms
            limit=rng.uniform(6, 7.5),
            sliding=(self.pull * rng.uniform(0.2, 0.4), 0.0),
            sticking=rng.uniform(1.3, 1.7),
            width=(width, width),
        )
        self.dirt = Dirt() if clean else dirt

    def spec(self):
        return specification(
            self, (coordinate("arm", "rad", -2.5, 2.5, (-0.1, 0.1)), angle("tilt", (math.pi - 0.1, math.pi + 0.1)))
        )

    def start(self, rng):
        return rng.uniform((-0.1, math.pi - 0.1), (0.1, math.pi + 0.1))

    def mass(self, q):
        s, coupling = math.sin(q[1]), self.rod * self.arm * self.centre * math.cos(q[1])
        whole = self.arm_inertia + self.rod * self.arm**2 + self.inertia * s**2
        return np.array([[whole, coupling], [coupling, self.inertia]])

    def forces(self, q, v, u):
        s, turning = math.sin(q[1]), self.inertia * math.sin(q[1]) * math.cos(q[1])
        across = self.rod * self.arm * self.centre * s
        motor = self.pull * u - 2 * turning * v[0] * v[1] + across * v[1] ** 2
        return np.array([motor, turning * v[0] ** 2 + self.rod * GRAVITY * self.centre * s]) - self.damping * v

    def energy(self, q, v):
        return 0.5 * v @ self.mass(q) @ v + self.rod * GRAVITY * self.centre * math.cos(q[1])

    def reward(self, read):
        return 0.5 + 0.5 * math.cos(read[1]) - 0.05 * read[0] ** 2

    def ended(self, read):
        return abs(read[0]) > 2.5


if __name__ == "__main__":
    main(Furuta)
