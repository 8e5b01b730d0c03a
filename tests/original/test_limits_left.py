"""Declared limits are the sampling range only if the environment stays near them."""

from __future__ import annotations

import numpy as np

from surrogym_sampler.original.describing.counting import Counted
from surrogym_sampler.original.describing.exploring import explore
from surrogym_sampler.original.describing.probing import ANYWHERE, Probed, probe
from surrogym_sampler.original.simulator import Simulator, Taken, Variable
from surrogym_shared.spec import BoxAction


class Kettle(Simulator):
    """A temperature that follows the heating, and runs away from where it is hotter than 0.8 of its limit."""

    def __init__(self, faster: float, **kind: object) -> None:
        self.variables = (Variable("heat", low=0.0, high=1.0, **kind),)  # type: ignore[arg-type]
        self.action = BoxAction(low=(0.0,), high=(0.5,))
        self.time_limit, self.rest = 50, np.zeros(1)
        self._heat, self._faster = np.full(1, 0.2), faster

    def reset(self, seed: int | None) -> np.ndarray:
        self._heat = np.full(1, 0.2)
        return self._heat

    def read(self) -> np.ndarray:
        return self._heat.copy()

    def write(self, state: np.ndarray) -> None:
        self._heat = state.copy()

    def step(self, action: np.ndarray) -> Taken:
        after = 0.8 * self._heat + 0.2 * action
        self._heat = np.where(self._heat > 0.8, self._faster * self._heat, after)
        return Taken(self._heat.copy(), 0.0, False, False)

    def observe(self) -> np.ndarray:
        return self._heat.copy()

    def close(self) -> None:
        pass


def probed(kettle: Kettle) -> tuple[Probed, int]:
    counted, rng = Counted(kettle), np.random.default_rng(0)
    found = probe(counted, explore(counted, 40, rng), rng)
    return found, counted.steps


def test_declared_limits_are_not_trusted_if_states_run_far_beyond_them():
    found, steps = probed(Kettle(faster=50.0))
    assert found.settable
    assert 0.1 < found.leaving < 0.6
    assert not found.stays
    assert steps >= 40 + ANYWHERE, "they are counted"


def test_declared_limits_that_states_exceed_slightly_are_trusted():
    assert probed(Kettle(faster=1.5))[0].stays


def test_limits_of_mechanical_joints_are_trusted_without_probing():
    found, steps = probed(Kettle(faster=50.0, motion="slide"))
    assert found.stays
    assert steps < 40 + ANYWHERE
