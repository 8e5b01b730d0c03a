"""Simulators that know only the physics, such as FMUs and MuJoCo models: the specification declares everything else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from surrogym_sampler.original.episodes import draw
from surrogym_sampler.original.errors import UnknownEnvironment
from surrogym_sampler.original.protocol import Array, RealStep
from surrogym_sampler.original.simulator import Simulated, Simulator
from surrogym_shared.logs.rewards import declared_reward
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.terms import terminates


class Unrewarded(Simulated):
    """A simulator without a reward, terminations and random starts of its own: the specification declares them."""

    def __init__(self, simulator: Simulator, spec: EnvironmentSpec) -> None:
        if spec.reward.kind != "declared":
            raise UnknownEnvironment(
                f"expected a declared reward for {spec.environment or 'a simulator'}, which has no reward of its own, "
                f"got a {spec.reward.kind} reward: declare it in the specification that surrogym describe writes "
                "(docs/how-to/fmus.md)"
            )
        super().__init__(simulator, spec)

    def begin(self, seed: int | None = None) -> Array:
        """Begin an episode: at a declared start if the state can be set, else at the simulator's own start values.
        Returns the coordinates (C,)."""
        if self._spec.query == "rollout":
            return super().begin(seed)
        self.place(draw(self._spec, np.random.default_rng(seed), wide=False))
        return self.coordinates()

    def act(self, action: Array) -> RealStep:
        """Apply an action (F,) in the current state. Reward and termination are computed as declared."""
        step = super().act(action)
        before, taken, after = (
            np.atleast_2d(np.asarray(x)) for x in (step.coordinates, step.action, step.next_coordinates)
        )
        ended = terminates(self._spec, after)
        paid = declared_reward(self._spec, before, taken, after, ended)
        return replace(step, reward=float(paid[0]), terminated=bool(ended[0]))
