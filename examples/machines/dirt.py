"""A mechanical machine with dirt: dead time, a limit of the actuator, friction that sticks, sensor noise and encoders.

Joints obey M(q) a = f(q, v, u) (M. W. Spong, S. Hutchinson, M. Vidyasagar, "Robot Modeling and Control", 2006, section
7.3). Friction is Coulomb's with a larger limit at rest: in each part of a step, an impulse stops the joint if the limit
allows it (J. J. Moreau's time stepping; D. E. Stewart, SIAM Review 42, 2000).

Shapes: n joints, r sensors. Units: SI, angles in rad.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

PARTS = 20  # parts of a step; a dead time is a whole number of parts
AT_REST = 1e-9  # a speed below this counts as 0
GRAVITY = 9.81


@dataclass(frozen=True)
class Dirt:
    """What is not in the textbook's equations; each default is a clean machine.

    Attributes:
        delay: parts of a step until an action takes effect.
        limit: largest action that the actuator gives, of either sign.
        sliding: friction of each joint (n,) that moves.
        sticking: friction at rest, a multiple of ``sliding``.
        noise: standard deviation of each sensor (r,); empty for none.
        width: distance of two counts of each encoder (r,); 0 is no encoder, and empty none at all.
    """

    delay: int = 0
    limit: float = math.inf
    sliding: tuple[float, ...] = ()
    sticking: float = 1.0
    noise: tuple[float, ...] = ()
    width: tuple[float, ...] = ()


class Machine:
    """A machine that is reset and acted on. A subclass has ``period`` (s), ``dirt``, and the methods without a body."""

    period: float
    dirt: Dirt

    def mass(self, q):
        """Return the mass matrix M (n, n) at joint positions q (n,)."""
        raise NotImplementedError

    def forces(self, q, v, u):
        """Return the forces f (n,) at positions q (n,), speeds v (n,) and the actuator's action u."""
        raise NotImplementedError

    def energy(self, q, v):
        """Return kinetic and potential energy."""
        raise NotImplementedError

    def start(self, rng):
        """Return joint positions (n,) after a reset, at which the machine rests."""
        raise NotImplementedError

    def sensed(self):
        """Return the positions (r,) that the r sensors see: here two."""
        return self.q[:2]

    def reset(self, seed=None):
        self._rng = np.random.default_rng(seed)
        self.q = np.array(self.start(self._rng))
        self.v = np.zeros(len(self.q))
        self._pipe = deque([0.0] * self.dirt.delay)
        return self.measured()

    def step(self, action):
        limited = min(max(action, -self.dirt.limit), self.dirt.limit)
        for _ in range(PARTS):
            self._pipe.append(limited)
            self.move(self._pipe.popleft(), self.period / PARTS)
        return self.measured()

    def measured(self):
        """Return what the sensors read (r,)."""
        read = np.array(self.sensed())
        if self.dirt.noise:
            read += np.array(self.dirt.noise) * self._rng.standard_normal(len(read))
        for sensor, width in enumerate(self.dirt.width):
            if width:
                read[sensor] = width * round(read[sensor] / width)
        return read

    def move(self, u, h):
        """Move for h seconds: a Runge-Kutta step, and then friction."""
        q, v = self.q, self.v
        v1, a1 = v, self._faster(q, v, u)
        v2, a2 = v + h / 2 * a1, self._faster(q + h / 2 * v1, v + h / 2 * a1, u)
        v3, a3 = v + h / 2 * a2, self._faster(q + h / 2 * v2, v + h / 2 * a2, u)
        v4, a4 = v + h * a3, self._faster(q + h * v3, v + h * a3, u)
        self.q = q + h / 6 * (v1 + 2 * v2 + 2 * v3 + v4)
        self.v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        for joint, friction in enumerate(self.dirt.sliding):
            if friction:
                self._rub(joint, h * friction, q[joint], rested=abs(v[joint]) < AT_REST)

    def _faster(self, q, v, u):
        return np.linalg.solve(self.mass(q), self.forces(q, v, u))

    def _rub(self, joint, most, before, *, rested):
        """Slow a joint down by an impulse of at most ``most``. A joint that rested and rests stays where it was."""
        column = np.linalg.inv(self.mass(self.q))[:, joint]
        stopping = -self.v[joint] / column[joint]
        if abs(stopping) <= most * (self.dirt.sticking if rested else 1.0):
            self.v = self.v + column * stopping
            self.v[joint] = 0.0
            if rested:
                self.q[joint] = before
        else:
            self.v = self.v + column * math.copysign(most, stopping)
