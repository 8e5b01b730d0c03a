"""A cart-pole whose motor pulls the cart by an elastic belt with play, on a rail whose friction sticks.

    surrogym doctor --env "exec:python examples/machines/belt.py --seed 1" --history 60

Encoders are at the motor and at the pole: nothing measures the cart or a speed. Cart-pole: R. V. Florian, "Correct
equations for the dynamics of the cart-pole system", 2007; two masses joined by a spring with play: M. Nordin, P.-O.
Gutman, "Controlling mechanical systems with backlash - a survey", Automatica 38, 2002. The seed draws the sizes.
"""

import math

import numpy as np
from dirt import GRAVITY, PARTS, Dirt, Machine
from program import angle, coordinate, main, specification, term

COUNTS, PULLEY = 2048, 0.1  # counts of a turn, m of belt in a turn


class Belt(Machine):
    """Joints: cart, pole and motor, all positions in m of the belt but for the pole's angle from upright. A clean
    machine has a stiff belt, so that the motor is part of the cart."""

    name, period, seconds, largest = "belt", 0.04, 5.0, 10.0  # -, s, s, N
    upright = (term("cos", "pole"),)

    def __init__(self, seed=0, clean=False):
        rng = np.random.default_rng([seed, 3])
        about = rng.uniform(0.85, 1.15, 5)
        self.cart, self.motor, self.pole, length = np.array([0.4, 0.2, 0.15, 0.5]) * about[:4]  # kg, kg, kg, m
        self.centre, self.inertia = length / 2, self.pole * length**2 / 3
        self.damping = np.array([0.2, 0.001, 0.5]) * about[4]
        self.stiffness, self.loss, self.play = rng.uniform(1500, 3000), 5.0, rng.uniform(0.0005, 0.002)  # N/m, N s/m, m
        sliding = rng.uniform(0.5, 1.0)
        dirt = Dirt(
            delay=round(PARTS * rng.uniform(0.1, 0.4)),
            limit=rng.uniform(8, 10),
            sliding=(sliding, 0.0, 0.2 * sliding),
            sticking=rng.uniform(1.3, 1.7),
            width=(PULLEY / COUNTS, 2 * math.pi / COUNTS),
        )
        self.stiff, self.dirt = clean, Dirt() if clean else dirt

    def spec(self):
        return specification(
            self, (coordinate("cart", "m", -0.5, 0.5, (-0.05, 0.05)), angle("pole", (math.pi - 0.1, math.pi + 0.1)))
        )

    def start(self, rng):
        cart, pole = rng.uniform((-0.05, math.pi - 0.1), (0.05, math.pi + 0.1))
        return (cart, pole) if self.stiff else (cart, pole, cart)

    def sensed(self):
        return self.q if self.stiff else self.q[[2, 1]]

    def mass(self, q):
        coupling = self.pole * self.centre * math.cos(q[1])
        if self.stiff:
            return np.array([[self.motor + self.cart + self.pole, coupling], [coupling, self.inertia]])
        return np.array([[self.cart + self.pole, coupling, 0], [coupling, self.inertia, 0], [0, 0, self.motor]])

    def forces(self, q, v, u):
        s = math.sin(q[1])
        free = np.array([self.pole * self.centre * s * v[1] ** 2, self.pole * GRAVITY * self.centre * s])
        if self.stiff:
            return free + np.array([u, 0]) - self.damping[:2] * v
        stretch = self._stretch(q)
        pull = self.stiffness * stretch + (self.loss * (v[2] - v[0]) if stretch else 0.0)
        return np.array([free[0] + pull, free[1], u - pull]) - self.damping * v

    def _stretch(self, q):
        apart = q[2] - q[0]
        return math.copysign(max(abs(apart) - self.play / 2, 0.0), apart)

    def energy(self, q, v):
        spring = 0.0 if self.stiff else 0.5 * self.stiffness * self._stretch(q) ** 2
        return 0.5 * v @ self.mass(q) @ v + self.pole * GRAVITY * self.centre * math.cos(q[1]) + spring

    def reward(self, read):
        return 0.5 + 0.5 * math.cos(read[1]) - 0.5 * read[0] ** 2

    def ended(self, read):
        return abs(read[0]) > 0.5


if __name__ == "__main__":
    main(Belt)
