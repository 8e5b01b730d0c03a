"""Cart-pole swing-up as in PILCO: a pole hangs from a cart and has to be balanced above it.

Physics and the narrow reward: M. P. Deisenroth, C. E. Rasmussen, "PILCO: A Model-Based and Data-Efficient Approach to
Policy Search", ICML 2011; equations of motion: M. P. Deisenroth, "Efficient Reinforcement Learning using Gaussian
Processes" (2010), appendix C. Units: m, s, rad, kg, N. The pictures are drawn with NumPy alone: a stroke colours each
pixel by the pixel's distance from a line.

Shapes: a frame is (height, width, 3) float64, 0 to 255. Points are in the world's units, y upwards from the middle.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from surrogym_client.registration import SWING_UP, SWING_UP_NARROW, SWING_UP_STEPS
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    EnvironmentSpec,
    Inequality,
    Normal,
    ObservationEntry,
    Reward,
    Success,
    Term,
    Uniform,
)

Frame = NDArray[np.float64]
Point = tuple[float, float]
Colour = tuple[int, int, int]

WHITE = 255.0


class Canvas:
    """A white frame on which strokes are drawn.

    Args:
        width: width in pixels.
        height: height in pixels.
        scale: pixels for each unit of the world, whose origin is in the middle.
    """

    def __init__(self, width: int, height: int, scale: float) -> None:
        self._frame: Frame = np.full((height, width, 3), WHITE)
        self._scale = scale
        self._x = (np.arange(width) + 0.5 - width / 2) / scale  # horizontal position of each pixel column (width,)
        # Vertical position of each pixel row (height, 1).
        self._y = (height / 2 - np.arange(height) - 0.5)[:, None] / scale

    def stroke(self, start: Point, end: Point, thickness: float, colour: Colour) -> None:
        """Draw a line with round ends; if both ends are the same point, a disc. Points and thickness are in units of
        the world."""
        (ax, ay), (bx, by) = start, end
        dx, dy = bx - ax, by - ay
        along = ((self._x - ax) * dx + (self._y - ay) * dy) / max(dx**2 + dy**2, 1e-12)
        nearest = np.clip(along, 0.0, 1.0)
        away = np.hypot(self._x - ax - nearest * dx, self._y - ay - nearest * dy) - thickness / 2
        # share of each pixel that the stroke covers; its edges are one pixel wide
        cover = np.clip(0.5 - away * self._scale, 0.0, 1.0)[..., None]
        self._frame += cover * (np.array(colour) - self._frame)

    def picture(self) -> NDArray[np.uint8]:
        """Return the frame as (height, width, 3) uint8."""
        return np.round(self._frame).astype(np.uint8)


MAX_FORCE = 10.0
START = 0.1  # half the width of the start distribution, for each coordinate
STEP_SECONDS = 0.1
SUBSTEPS = 10
GRAVITY = 9.82
LENGTH = 0.6
PIXELS_PER_METRE = 120

# Distance (m) of the pole's tip from its target at which the reward falls to exp(-1/2). A hanging pole is 1.2 m away,
# which earns 0.14 under the smooth reward and 1e-5 under PILCO's narrow one.
WIDTH = {"smooth": 0.6, "narrow": 0.25}

State = tuple[float, float, float, float]


class CartPoleSwingUp(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """The swing-up task as a Gymnasium environment.

    State: position, velocity, angle (0 if the pole hangs, counter-clockwise), angular velocity. Action: force in N.
    Observation: position, velocity, cosine and sine of the angle, angular velocity, and the horizontal position of the
    pole's tip.

    The reward depends on the state after the step: exp(-d^2 / (2 width^2)), where d is the distance of the pole's tip
    from its target, the position when the pole stands above the origin. No state ends an episode. Pictures mark the
    target.
    """

    dt = STEP_SECONDS
    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / STEP_SECONDS)}  # noqa: RUF012 (Gymnasium's type)

    def __init__(self, reward: Literal["smooth", "narrow"] = "smooth", render_mode: str | None = None) -> None:
        if reward not in WIDTH:
            raise ValueError(f"argument reward: expected one of {', '.join(WIDTH)}, got {reward!r}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"argument render_mode: expected None or rgb_array, got {render_mode!r}")
        self.render_mode = render_mode
        self.masscart, self.masspole, self.length, self.friction = 0.5, 0.5, LENGTH, 0.1
        self.width = WIDTH[reward]
        self.state: NDArray[np.float64] = np.zeros(4)
        ends = np.array([np.inf, np.inf, 1, 1, np.inf, np.inf], dtype=np.float32)
        self.observation_space = spaces.Box(-ends, ends, dtype=np.float32)
        self.action_space = spaces.Box(-MAX_FORCE, MAX_FORCE, (1,), dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed, options=options)
        self.state = self.np_random.uniform(-START, START, 4)
        return self._observation(), {}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        force = float(np.clip(action[0], -MAX_FORCE, MAX_FORCE))
        x, velocity, angle, omega = map(float, self.state)
        state = (x, velocity, angle, omega)
        for _ in range(SUBSTEPS):
            state = self._runge_kutta(state, force, STEP_SECONDS / SUBSTEPS)
        self.state = np.array(state)
        return self._observation(), self._reward(), False, False, {}

    def render(self) -> Any:
        """Return the picture (300, 600, 3) of the state, which shows 5 m by 2.5 m; None without a render mode."""
        if self.render_mode is None:
            return None
        x, _, angle, _ = map(float, self.state)
        tip = (self._tip(x, angle), -self.length * math.cos(angle))
        canvas = Canvas(600, 300, PIXELS_PER_METRE)
        canvas.stroke((-3, 0), (3, 0), 0.01, (120, 120, 120))
        canvas.stroke((0, self.length), (0, self.length), 0.1, (240, 190, 180))
        canvas.stroke((x - 0.15, 0), (x + 0.15, 0), 0.14, (40, 40, 40))
        canvas.stroke((x, 0), tip, 0.06, (202, 152, 101))
        return canvas.picture()

    def _runge_kutta(self, state: State, force: float, h: float) -> State:
        k1 = self._derivative(state, force)
        k2 = self._derivative(_ahead(state, k1, h / 2), force)
        k3 = self._derivative(_ahead(state, k2, h / 2), force)
        k4 = self._derivative(_ahead(state, k3, h), force)
        slope = [(a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(k1, k2, k3, k4, strict=True)]
        return _ahead(state, (slope[0], slope[1], slope[2], slope[3]), h)

    def _derivative(self, state: State, force: float) -> State:
        """Return the time derivative of the state, by the equations of motion of a uniform rod on a cart with viscous
        friction."""
        _, velocity, angle, omega = state
        m, length, total = self.masspole, self.length, self.masscart + self.masspole
        sin, cos = math.sin(angle), math.cos(angle)
        push = force - self.friction * velocity
        swing = m * length * omega**2 * sin
        weight = 4 * total - 3 * m * cos**2
        acceleration = (2 * swing + 3 * m * GRAVITY * sin * cos + 4 * push) / weight
        angular = -3 * (swing * cos + 2 * total * GRAVITY * sin + 2 * push * cos) / (length * weight)
        return velocity, acceleration, omega, angular

    def _reward(self) -> float:
        x, _, angle, _ = self.state
        across, below = self._tip(x, angle), self.length * (1 + math.cos(angle))
        return math.exp(-(across**2 + below**2) / (2 * self.width**2))

    def _observation(self) -> NDArray[np.float32]:
        x, velocity, angle, omega = self.state
        shown = [x, velocity, math.cos(angle), math.sin(angle), omega, self._tip(x, angle)]
        return np.array(shown, dtype=np.float32)

    def _tip(self, x: float, angle: float) -> float:
        """Return the horizontal position of the pole's tip."""
        return x + self.length * math.sin(angle)


def _ahead(state: State, slope: State, h: float) -> State:
    x, velocity, angle, omega = (s + h * k for s, k in zip(state, slope, strict=True))
    return x, velocity, angle, omega


def swing_up() -> EnvironmentSpec:
    """Return the specification of the swing-up with a smooth reward, which is noticeable from every state."""
    return _specification(SWING_UP)


def swing_up_narrow() -> EnvironmentSpec:
    """Return the specification of the swing-up with PILCO's reward, which is almost 0 except near the target."""
    return _specification(SWING_UP_NARROW)


def _specification(environment: str) -> EnvironmentSpec:
    circle = Uniform(low=-math.pi, high=math.pi)
    linear = {name: Term.linear(**{name: 1.0}) for name in ("x", "velocity", "omega")}
    shown = {
        "x": linear["x"],
        "velocity": linear["velocity"],
        "cos": Term.cos(angle=1),
        "sin": Term.sin(angle=1),
        "omega": linear["omega"],
        "tip": linear["x"] + LENGTH * Term.sin(angle=1),
    }
    on_circle = ("cos", "sin")
    return EnvironmentSpec(
        environment=environment,
        coordinates=(
            Coordinate(name="x", sampling=Uniform(low=-1.5, high=1.5), unit="m"),
            Coordinate(name="velocity", sampling=Normal(mean=0, std=1.5), unit="m/s"),
            Coordinate(name="angle", kind="angle", sampling=circle, unit="rad"),
            Coordinate(name="omega", sampling=Normal(mean=0, std=4), unit="rad/s"),
        ),
        observation=tuple(
            ObservationEntry(name=n, term=t, low=-1 if n in on_circle else None, high=1 if n in on_circle else None)
            for n, t in shown.items()
        ),
        action=BoxAction(low=(-MAX_FORCE,), high=(MAX_FORCE,)),
        start={name: Uniform(low=-START, high=START) for name in ("x", "velocity", "angle", "omega")},
        time_limit=SWING_UP_STEPS,
        sampling_period=STEP_SECONDS,
        reward=Reward(timing="after"),
        success=Success(hold=(Inequality(term=Term.cos(angle=1), relation="<", value=-0.95),), hold_steps=20),
    )
