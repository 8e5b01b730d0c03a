"""What model-based peers are told about each task beforehand: its reward, PILCO's cost, and a horizon.

Their publications assume that the reward or cost is known. Here it is written by hand, task by task.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from surrogym_client.registration import SWING_UP, SWING_UP_NARROW
from surrogym_lab.peers import figures
from surrogym_lab.peers.port import NotApplicable
from surrogym_sampler.original.protocol import Array
from surrogym_sampler.original.swingup import LENGTH, WIDTH
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.terms import terminates

Rewarding = Callable[[Array, Array, Array], Array]
"""Rewards (N,) of states (N, C), controls (N, F) in [-1, 1] and reached states (N, C)."""


@dataclass(frozen=True)
class TipCost:
    """PILCO's saturating cost 1 - exp(-d^2 / (2 width^2)), d the distance of a tip from its goal (Deisenroth and
    Rasmussen 2011, equation 25).

    With angles a = B q, the tip is ``linear`` q + ``sines`` sin(a) + ``cosines`` cos(a); one row for each of its
    coordinates.
    """

    angles: Array  # B (G, C)
    linear: Array  # (T, C)
    sines: Array  # (T, G)
    cosines: Array  # (T, G)
    goal: Array  # (T,)
    width: float


@dataclass(frozen=True)
class Told:
    """What is told about one task.

    Attributes:
        reward: the environment's own.
        cost: PILCO's; None if the task has none.
        horizon: number of controls in an episode of learning.
        repeat: real steps that each control is applied for.
    """

    reward: Rewarding
    cost: TipCost | None
    horizon: int
    repeat: int = 1


def told(spec: EnvironmentSpec) -> Told:
    """Return what is told about an environment.

    Raises:
        NotApplicable: nobody has written it down.
    """
    if spec.environment not in TOLD:
        raise NotApplicable(f"a model-based peer has to know the reward: expected one of {', '.join(TOLD)}")
    return TOLD[spec.environment]


def survives(spec: EnvironmentSpec, q: Array) -> Array:
    """Whether (N,) an episode continues at q (N, C), as 1.0 or 0.0."""
    return (~terminates(spec, q)).astype(np.float64)


def _pendulum(q: Array, u: Array, reached: Array) -> Array:
    """Gymnasium's reward, of the state before the step."""
    del reached
    angle = (q[:, 0] + np.pi) % (2 * np.pi) - np.pi
    cost: Array = angle**2 + 0.1 * q[:, 1] ** 2 + 0.001 * (2 * u[:, 0]) ** 2
    return -cost


def _one(q: Array, u: Array, reached: Array) -> Array:
    del u, reached
    return np.ones(len(q))


def _swing_up(width: float) -> Rewarding:
    def reward(q: Array, u: Array, reached: Array) -> Array:
        del q, u
        x, angle = reached[:, 0], reached[:, 2]
        across, below = x + LENGTH * np.sin(angle), LENGTH * (1 + np.cos(angle))
        paid: Array = np.exp(-(across**2 + below**2) / (2 * width**2))
        return paid

    return reward


def _rod(q: Array, u: Array, reached: Array) -> Array:
    del q, u
    return figures.reward(reached)


def _mujoco_cart(q: Array, u: Array, reached: Array) -> Array:
    del q
    return figures.cart_reward(reached, figures.CART_CONTROL * u)


def _acrobot(q: Array, u: Array, reached: Array) -> Array:
    del q, u
    height = -np.cos(reached[:, 0]) - np.cos(reached[:, 0] + reached[:, 1])
    return np.where(height > 1, 0.0, -1.0)


def _swing_up_cost(width: float) -> TipCost:
    return TipCost(
        angles=np.array([[0, 0, 1.0, 0]]),
        linear=np.array([[1.0, 0, 0, 0], [0, 0, 0, 0]]),
        sines=np.array([[LENGTH], [0]]),
        cosines=np.array([[0], [LENGTH]]),
        goal=np.array([0, -LENGTH]),
        width=width,
    )


def _pendulum_cost(upright: float) -> TipCost:
    """The cost of a pendulum whose angle has this cosine at its goal."""
    return TipCost(
        angles=np.array([[1.0, 0]]),
        linear=np.zeros((2, 2)),
        sines=np.array([[1.0], [0]]),
        cosines=np.array([[0], [1.0]]),
        goal=np.array([0, upright]),
        width=0.5,
    )


TOLD = {
    "Pendulum-v1": Told(
        _pendulum,
        _pendulum_cost(upright=1.0),
        horizon=40,
        repeat=2,
    ),
    figures.NAME: Told(_rod, _pendulum_cost(upright=-1.0), horizon=40),
    figures.CART_NAME: Told(_mujoco_cart, None, horizon=figures.CART_STEPS),
    "CartPole-v1": Told(
        _one,
        TipCost(  # the cart's position, and ten times the pole's angle
            angles=np.zeros((0, 4)),
            linear=np.array([[1.0, 0, 0, 0], [0, 0, 10.0, 0]]),
            sines=np.zeros((2, 0)),
            cosines=np.zeros((2, 0)),
            goal=np.zeros(2),
            width=1.0,
        ),
        horizon=500,
    ),
    SWING_UP: Told(_swing_up(WIDTH["smooth"]), _swing_up_cost(WIDTH["smooth"]), horizon=40),
    SWING_UP_NARROW: Told(_swing_up(WIDTH["narrow"]), _swing_up_cost(WIDTH["narrow"]), horizon=40),
    "Acrobot-v1": Told(
        _acrobot,
        TipCost(
            angles=np.array([[1.0, 0, 0, 0], [1.0, 1.0, 0, 0]]),
            linear=np.zeros((2, 4)),
            sines=np.array([[1.0, 1.0], [0, 0]]),
            cosines=np.array([[0, 0], [-1.0, -1.0]]),
            goal=np.array([0, 2.0]),
            width=1.0,
        ),
        horizon=100,
    ),
}
