"""Integrals of errors as observations: a policy also sees how far a coordinate was from its set point so far.

The sum of the errors since the reset is clipped to [-1, 1], so it remembers the last steps alone while the coordinate
is far from its set point. A policy that sees it can hold the set point with a weaker pump, or with an offset in the
action.

Shapes: N lanes or episodes, D observation entries, K integrals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.port import Bools, Floats, Ints, ResetResult, StepResult, SurrogatePort
from surrogym_shared.set_points import line_of, set_points_of, with_set_points
from surrogym_shared.spec import EnvironmentSpec, ObservationEntry, Term, limits
from surrogym_shared.wire import OpenSession, SessionView, SubmittedOccupancy
from surrogym_trainer.policies.predict import Acting, PerEpisode, Predict

UNIT = 0.05  # error, as a share of the coordinate's sampling range, that moves an integral from 0 to an end in one step


@dataclass(frozen=True)
class Error:
    """The error of a coordinate ``name`` from its ``set_point``; an error of ``unit`` moves the integral by 1."""

    name: str
    set_point: float
    unit: float


def errors_of(spec: EnvironmentSpec, names: Sequence[str], set_points: Mapping[str, float]) -> tuple[Error, ...]:
    """Return the errors of coordinates. Arguments are those of ``Integrals.of``.

    Raises:
        ValueError: the reward does not have a set point of a coordinate.
    """
    known, errors = set_points_of(with_set_points(spec, set_points)), []
    for name in names:
        if len(known.get(name, ())) != 1:
            raise ValueError(
                f"integral: expected a coordinate with one set point in a declared reward, "
                f"{' or '.join(map(repr, known)) or 'which this reward does not have'}, got {name!r}"
            )
        low, high = limits(spec.coordinates[spec.coordinate_names.index(name)].sampling)
        errors.append(Error(name, known[name][0], UNIT * (high - low)))
    return tuple(errors)


@dataclass(frozen=True)
class Integrals:
    """Running sums of the errors of K coordinates, computed from observations."""

    columns: Ints  # (K,) observation entry that shows each coordinate
    slopes: Floats  # (K,) factor of this entry in the error
    constants: Floats  # (K,) constant in the error

    @classmethod
    def of(cls, spec: EnvironmentSpec, names: Sequence[str], set_points: Mapping[str, float]) -> Self:
        """Return the integrals of the errors of coordinates.

        Args:
            spec: specification with a declared reward.
            names: names of the K coordinates.
            set_points: set points that replace those of the reward, by coordinate.

        Raises:
            ValueError: the reward does not have a set point of a coordinate, or the observation does not show it.
        """
        shown, rows = [(i, line_of(one.term)) for i, one in enumerate(spec.observation)], []
        for error in errors_of(spec, names, set_points):
            lines = [(i, *line[1:]) for i, line in shown if line is not None and line[0] == error.name]
            if not lines:
                raise ValueError(f"integral: expected a coordinate that an observation entry shows, got {error.name!r}")
            column, slope, constant = lines[0]
            rows.append((column, 1 / (slope * error.unit), -(constant / slope + error.set_point) / error.unit))
        columns, slopes, constants = zip(*rows, strict=True)
        return cls(np.array(columns), np.array(slopes), np.array(constants))

    def after(self, sums: Floats, observation: Floats) -> Floats:
        """Return the sums (N, K) after a step that led to observations (N, D)."""
        added: Floats = np.clip(sums + observation[:, self.columns] * self.slopes + self.constants, -1.0, 1.0)
        return added


def with_integrals(port: SurrogatePort, names: Sequence[str], set_points: Mapping[str, float]) -> SurrogatePort:
    """Return a surrogate whose observations also have integrals of errors. Arguments and errors are those of
    ``Integrals.of``. Without names, ``port`` itself is returned, and so is a surrogate that has them already."""
    if not names or isinstance(port, IntegralPort):
        return port
    return IntegralPort(port, Integrals.of(port.spec(), names, set_points), tuple(names))


def acting_with_integrals(
    predict: Predict, spec: EnvironmentSpec | None, names: Sequence[str], set_points: Mapping[str, float]
) -> Acting:
    """Return a policy that sees integrals of errors as a controller of an environment whose observations lack them.
    Arguments and errors are those of ``Integrals.of``. Without names, the policy itself is returned."""
    if not names or spec is None:
        return predict
    return _Integrating(predict, Integrals.of(spec, names, set_points))


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
        return self.predict(_joined(observations, np.stack([self._sums[episode] for episode in episodes])))


@dataclass
class _Sums:
    """The integrals of the lanes of a session."""

    now: Floats  # (N, K)
    ended: Bools  # (N,) lanes whose episode has ended and that have not been reset


@dataclass
class IntegralPort(SurrogatePort):
    """A surrogate whose observations also have integrals of errors, which are computed here."""

    port: SurrogatePort
    integrals: Integrals
    names: tuple[str, ...]
    _sessions: dict[str, _Sums] = field(default_factory=dict)

    def acting(self, predict: Predict) -> Acting:
        """Return a policy of this surrogate as a controller of the original environment."""
        return _Integrating(predict, self.integrals)

    def spec(self) -> EnvironmentSpec:
        spec = self.port.spec()
        # The entries only count the numbers of an observation: an integral is no function of the state.
        more = (ObservationEntry(name=f"integral of {n}", term=Term.constant(0.0), low=-1, high=1) for n in self.names)
        return spec.model_copy(update={"observation": (*spec.observation, *more)})

    def open(self, request: OpenSession) -> SessionView:
        view, size = self.port.open(request), len(self.names)
        self._sessions[view.id] = _Sums(np.zeros((view.num_envs, size)), np.zeros(view.num_envs, dtype=bool))
        space = view.observation_space
        ends = {"low": [*space.low, *[-1.0] * size], "high": [*space.high, *[1.0] * size]}
        return view.model_copy(update={"observation_space": space.model_copy(update=ends)})

    def reset(self, session: str, *, seed: int | Sequence[int] | None = None, mask: Bools | None = None) -> ResetResult:
        result, sums = self.port.reset(session, seed=seed, mask=mask), self._sessions[session]
        self._begin(sums, slice(None) if mask is None else mask)
        return replace(result, observation=_joined(result.observation, sums.now))

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
        last = _joined(result.final_observation, sums.now[final])
        self._begin(sums, began)
        self._begin(sums, final)
        sums.ended = sums.ended | (stepped & (result.terminated | result.truncated))
        sums.ended[final] = False
        return replace(result, observation=_joined(result.observation, sums.now), final_observation=last)

    @staticmethod
    def _begin(sums: _Sums, lanes: Any) -> None:
        sums.now[lanes], sums.ended[lanes] = 0.0, False


def _joined(observation: Floats, sums: Floats) -> Floats:
    joined: Floats = np.concatenate([observation, sums.astype(observation.dtype)], axis=1)
    return joined
