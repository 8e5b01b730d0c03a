"""A cart that must not leave its rail, in modules of their own because it is made in child processes."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np

from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    Design,
    EnvironmentSpec,
    Limit,
    Limits,
    ObservationEntry,
    Term,
    Uniform,
)
from surrogym_shared.spec.safety import NamedFallback

DIARY = "CART_DIARY"  # environment variable: the file that each action is noted in
BRAKING = 0.3  # seconds of the present speed within which the fallback stops the cart
RAIL = Limit(name="rail", term=Term.linear(x=1.0, v=BRAKING), low=-1.0, high=1.0, margin=0.4)
BRAKE = Term.linear(x=-0.5, v=-1.6)
LIMITS = Limits(keep=(RAIL,), fallback=(BRAKE,))
SPEC = EnvironmentSpec(
    environment="a cart",
    coordinates=(
        Coordinate(name="x", sampling=Uniform(low=-1.5, high=1.5), unit="m"),
        Coordinate(name="v", sampling=Uniform(low=-3, high=3), unit="m/s"),
    ),
    observation=(
        ObservationEntry(name="x", term=Term.linear(x=1)),
        ObservationEntry(name="v", term=Term.linear(v=1)),
    ),
    action=BoxAction(low=(-1.0,), high=(1.0,)),
    start={"x": Uniform(low=-0.1, high=0.1), "v": Uniform(low=-0.1, high=0.1)},
    time_limit=40,
    sampling_period=0.1,
    query="rollout",
    limits=LIMITS,
    design=Design(initial=12, budget=60),
)


def with_limits(limits: Limits | None) -> EnvironmentSpec:
    return EnvironmentSpec.model_validate({**SPEC.model_dump(), "limits": limits and limits.model_dump()})


class Cart:
    """v' = v + u / 2, x' = x + v' / 10; the reward is the way to the right. It does not wait for its actions."""

    def __init__(self, spec: EnvironmentSpec = SPEC) -> None:
        self._spec = spec
        self.x = self.v = 0.0

    def spec(self):
        return self._spec

    def reset(self, *, seed=None):
        self.x, self.v = np.random.default_rng(seed).uniform(-0.1, 0.1, 2)
        return np.array([self.x, self.v]), {}

    def step(self, action):
        if name := os.environ.get(DIARY):
            with Path(name).open("a") as diary:
                diary.write(f"{float(action[0]):.6f} {self.x:.6f} {self.v:.6f}\n")
        self.v += float(action[0]) / 2
        self.x += self.v / 10
        return np.array([self.x, self.v]), self.x, False, False, {}

    def coordinates(self, observation):
        return observation

    def close(self):
        if name := os.environ.get(DIARY):
            with Path(name).open("a") as diary:
                diary.write("close\n")


class PatientCart(Cart):
    """The same as a simulator, which waits for its actions."""

    parallel = True


class SlowCart(Cart):
    """A cart whose weak brake takes many steps, and whose steps take time."""

    def __init__(self, spec: EnvironmentSpec | None = None) -> None:
        super().__init__(spec or with_limits(Limits(keep=(RAIL,), fallback=(Term.linear(v=-0.4),))))

    def step(self, action):
        time.sleep(0.03)
        return super().step(action)


class LateCart(SlowCart):
    """The same, whose third step takes a second longer."""

    def __init__(self) -> None:
        super().__init__()
        self._steps = 0

    def step(self, action):
        self._steps += 1
        time.sleep(1.0 if self._steps == 3 else 0.0)
        return super().step(action)


class LeavingCart(PatientCart):
    """A strong cart whose limit most steps leave."""

    def __init__(self) -> None:
        rail = RAIL.model_copy(update={"low": -0.2, "high": 0.2, "margin": 0.05})
        super().__init__(with_limits(Limits(keep=(rail,), fallback=(Term.constant(1.0),))))

    def step(self, action):
        return super().step(4 * np.asarray(action))


def brake(coordinates):
    """What the fallback of the other carts does, as a program."""
    x, v = coordinates
    return [-0.5 * x - 1.6 * v]


def two(coordinates):
    """A program with an entry too many."""
    return [0.0, 0.0]


def broken(coordinates):
    """A program that fails."""
    raise RuntimeError("no pressure")


class NamedCart(PatientCart):
    """A cart whose limits name their fallback."""

    def __init__(self) -> None:
        super().__init__(with_limits(Limits(keep=(RAIL,), fallback=NamedFallback(name="brake"))))


class FreeCart(Cart):
    """A cart that declares no limits."""

    def __init__(self) -> None:
        super().__init__(with_limits(None))
