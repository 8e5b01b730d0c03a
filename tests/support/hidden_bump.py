"""A point in n dimensions that is paid in one place alone, and next to nothing anywhere else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from surrogym_sampler.original import RealStep
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    DeclaredReward,
    Design,
    EnvironmentSpec,
    ObservationEntry,
    Quantity,
    Reward,
    RewardTerm,
    Term,
    Uniform,
)

RANGE, SPEED, PLACES = 3.0, 0.2, 2.0  # half widths of the range and of where the bump may be; how far a step goes


@dataclass(frozen=True)
class HiddenBump:
    """reward = exp(-1/2 |x - place|^2 / width^2), x' = x + 0.2 u; ``seed`` says where the bump is."""

    dimensions: int = 2
    seed: int = 0
    width: float = 0.1
    declared: bool = False  # whether the specification says what is paid
    cost: float = 0.0  # of an action of size 1 in every dimension
    toll: float = 0.0  # of each step
    reach: float | None = None  # how far from the bump episodes start, in each dimension; None: anywhere

    @property
    def place(self) -> np.ndarray:
        rng = np.random.default_rng([self.seed, self.dimensions])
        return np.asarray(rng.uniform(-PLACES, PLACES, self.dimensions).round(3))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"x{i}" for i in range(self.dimensions))

    def spec(self) -> EnvironmentSpec:
        around = {name: Uniform(low=-RANGE, high=RANGE) for name in self.names}
        return EnvironmentSpec(
            environment="hidden_bump",
            coordinates=tuple(Coordinate(name=n, sampling=around[n]) for n in self.names),
            observation=tuple(ObservationEntry(name=n, term=Term.linear(**{n: 1})) for n in self.names),
            action=BoxAction(low=(-1.0,) * self.dimensions, high=(1.0,) * self.dimensions),
            start=around if self.reach is None else self._near(self.reach),
            time_limit=100,
            reward=self._declared() if self.declared else Reward(),
            design=Design(seed=self.seed),
        )

    def step_from(self, coordinates: ArrayLike, action: ArrayLike) -> RealStep:
        x, u = np.asarray(coordinates, dtype=float), np.clip(np.asarray(action, dtype=float), -1, 1)
        after = x + SPEED * u
        return RealStep(tuple(x), tuple(u), tuple(after), self.pay(x, u))

    def pay(self, x: np.ndarray, u: np.ndarray) -> float:
        return float(
            np.exp(-0.5 * (((x - self.place) / self.width) ** 2).sum()) - self.cost * (u**2).mean() - self.toll
        )

    def close(self) -> None:
        pass

    def _near(self, reach: float) -> dict[str, Uniform]:
        return {n: Uniform(low=p - reach, high=p + reach) for n, p in zip(self.names, self.place.tolist(), strict=True)}

    def _declared(self) -> DeclaredReward:
        across = (
            Quantity(term=Term.linear(**{name: 1 / self.width}) + Term.constant(-place / self.width))
            for name, place in zip(self.names, self.place.tolist(), strict=True)
        )
        return DeclaredReward(kind="declared", timing="before", terms=(RewardTerm(shape="bump", of=tuple(across)),))
