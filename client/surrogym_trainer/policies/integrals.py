"""Policies that observe integrals of errors, in virtual episodes and at the machine (``surrogym_shared.integrals``).

Shapes: N lanes or episodes, D observation entries, K integrals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.integrals import Error, Integrals, errors_of, joined
from surrogym_shared.port import Bools, Floats, Ints, ResetResult, StepResult, SurrogatePort
from surrogym_shared.spec import EnvironmentSpec, ObservationEntry, Term
from surrogym_shared.wire import OpenSession, SessionView, SubmittedOccupancy
from surrogym_trainer.policies.predict import Acting, PerEpisode, Predict


def with_integrals(port: SurrogatePort, names: Sequence[str], set_points: Mapping[str, float]) -> SurrogatePort:
    """Return a surrogate whose observations also have integrals of errors. Arguments and errors are those of
    ``errors_of`` and ``Integrals.of``. Without names, ``port`` itself is returned, and so is a surrogate that has them
    already."""
    if not names or isinstance(port, IntegralPort):
        return port
    return IntegralPort(port, errors_of(port.spec(), names, set_points))


def acting_with_integrals(
    predict: Predict, spec: EnvironmentSpec | None, names: Sequence[str], set_points: Mapping[str, float]
) -> Acting:
    """Return a policy that sees integrals of errors as a controller of an environment whose observations lack them.
    Arguments and errors are those of ``errors_of`` and ``Integrals.of``. Without names, the policy itself is
    returned."""
    if not names or spec is None:
        return predict
    return _Integrating(predict, Integrals.of(spec, errors_of(spec, names, set_points)))


@dataclass
class _Integrating(PerEpisode):
    predict: Predict
    integrals: Integrals
    _sums: dict[int, Floats] = field(default_factory=dict)  # (K,) sums, by the number of the episode

    def actions(self, episodes: Sequence[int], observations: NDArray[np.float32]) -> NDArray[Any]:
        for episode, observation in zip(episodes, observations, strict=True):
            if (sums := self._sums.get(episode)) is None:
                self._sums[episode] = np.zeros(len(self.integrals.columns))
            else:
                self._sums[episode] = self.integrals.after(sums[None], observation[None])[0]
        return self.predict(joined(observations, np.stack([self._sums[episode] for episode in episodes])))


@dataclass
class _Sums:
    """The integrals of the lanes of a session."""

    now: Floats  # (N, K)
    ended: Bools  # (N,) lanes whose episode has ended and that have not been reset


@dataclass
class IntegralPort(SurrogatePort):
    """A surrogate whose observations also have integrals of errors, which are computed here."""

    port: SurrogatePort
    errors: tuple[Error, ...]
    _sessions: dict[str, _Sums] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.integrals = Integrals.of(self.port.spec(), self.errors)

    def acting(self, predict: Predict) -> Acting:
        """Return a policy of this surrogate as a controller of the original environment."""
        return _Integrating(predict, self.integrals)

    def spec(self) -> EnvironmentSpec:
        spec = self.port.spec()
        # The entries only count the numbers of an observation: an integral is no function of the state.
        more = (
            ObservationEntry(name=f"integral of {error.name}", term=Term.constant(0.0), low=-1, high=1)
            for error in self.errors
        )
        return spec.model_copy(update={"observation": (*spec.observation, *more)})

    def open(self, request: OpenSession) -> SessionView:
        view, size = self.port.open(request), len(self.errors)
        self._sessions[view.id] = _Sums(np.zeros((view.num_envs, size)), np.zeros(view.num_envs, dtype=bool))
        space = view.observation_space
        ends = {"low": [*space.low, *[-1.0] * size], "high": [*space.high, *[1.0] * size]}
        return view.model_copy(update={"observation_space": space.model_copy(update=ends)})

    def reset(self, session: str, *, seed: int | Sequence[int] | None = None, mask: Bools | None = None) -> ResetResult:
        result, sums = self.port.reset(session, seed=seed, mask=mask), self._sessions[session]
        self._begin(sums, slice(None) if mask is None else mask)
        return replace(result, observation=joined(result.observation, sums.now))

    def step(
        self, session: str, action: Floats | Ints, *, mask: Bools | None = None, deviations: bool = False
    ) -> StepResult:
        return self._summed(session, self.port.step(session, action, mask=mask, deviations=deviations), mask)

    def rollout(self, session: str, actions: Floats | Ints) -> list[StepResult]:
        return [self._summed(session, result, None) for result in self.port.rollout(session, actions)]

    def submit_occupancy(self, session: str, checkpoint: str) -> SubmittedOccupancy:
        return self.port.submit_occupancy(session, checkpoint)

    def close(self, session: str) -> None:
        self._sessions.pop(session, None)
        self.port.close(session)

    def _summed(self, session: str, result: StepResult, mask: Bools | None) -> StepResult:
        """Return the result of a step with the integrals after it."""
        sums, final = self._sessions[session], result.final_lanes
        stepped = np.ones(len(sums.now), dtype=bool) if mask is None else np.asarray(mask)
        arrived = result.observation.copy()
        arrived[final] = result.final_observation
        began = stepped & sums.ended  # this step reset lanes whose episode had ended before
        sums.now = np.where((stepped & ~began)[:, None], self.integrals.after(sums.now, arrived), sums.now)
        last = joined(result.final_observation, sums.now[final])
        self._begin(sums, began)
        self._begin(sums, final)
        sums.ended = sums.ended | (stepped & (result.terminated | result.truncated))
        sums.ended[final] = False
        return replace(result, observation=joined(result.observation, sums.now), final_observation=last)

    @staticmethod
    def _begin(sums: _Sums, lanes: Any) -> None:
        sums.now[lanes], sums.ended[lanes] = 0.0, False
