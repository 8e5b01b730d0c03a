"""``LocalSurrogate``: a surrogate whose sessions run in this process, without a server. Install it as
surrogym[server]."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_server.convert import stored_definition
from surrogym_server.convert.sessions import opening, session_view
from surrogym_server.engine.requests import (
    Advance,
    Open,
    PolicySteps,
    Reset,
    Rollout,
    Step,
    carried_out,
    info_of,
    opened,
    visited_states,
)
from surrogym_server.engine.session import Outcome, Session, check_opening, digest_of
from surrogym_server.errors import InvalidInput, UnknownModel, UnknownSession
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.port import DynamicsModel
from surrogym_server.planning import Planner, planner_of
from surrogym_shared.acting import ActingPolicy, NoiseKey, PolicyRun
from surrogym_shared.limits import distances, limit_of
from surrogym_shared.port import Bools, Floats, Ints, PolicyRollout, ResetResult, StepResult, quick
from surrogym_shared.spec import EnvironmentSpec, Limit
from surrogym_shared.surrogate_file import SurrogateFile
from surrogym_shared.wire import OpenSession, SessionView, SubmittedOccupancy

VERSION = 1
# number of virtual episodes in which a planner's limit is tried, and their largest number of steps
TRIED, LONGEST = 4, 200


class LocalSurrogate:
    """A surrogate with one model, whose sessions run in this process. It implements ``SurrogatePort``, the interface by
    which trainers use a surrogate.

    Its methods raise the errors of ``surrogym_server.errors``.

    Args:
        spec: specification of the original environment.
        model: model of the original environment; its version is 1.

    Examples:
        >>> surrogate = LocalSurrogate.from_file("pendulum.surrogate")
        >>> env = SurrogateVecEnv.from_port(surrogate, num_envs=16)
    """

    def __init__(self, spec: EnvironmentSpec, model: DynamicsModel) -> None:
        self._spec = spec
        self._model = model
        self._models = _OneModel(model)
        self._sessions: dict[str, Session] = {}

    @classmethod
    def from_bytes(cls, spec: EnvironmentSpec, model: bytes) -> Self:
        """Make a surrogate from a specification and the content of a model's file.

        Raises:
            InvalidInput: the model does not fit the specification.
        """
        return cls(spec, from_bytes(stored_definition(spec), model))

    @classmethod
    def from_file(cls, path: str | Path) -> Self:
        """Read a surrogate from a file that ``surrogym export`` wrote.

        Raises:
            OSError: the file can't be read.
            NotASurrogateFile: the file is not one of ``surrogym export``.
            InvalidInput: the model in the file does not fit its specification.
        """
        file = SurrogateFile.load(path)
        return cls.from_bytes(file.spec, file.model)

    def spec(self) -> EnvironmentSpec:
        return self._spec

    @property
    def model(self) -> DynamicsModel:
        """The model that computes the steps."""
        return self._model

    def model_file(self) -> bytes:
        return to_bytes(self._model)

    def planner(
        self,
        horizon: int,
        seed: int = 0,
        set_points: Mapping[str, float] | None = None,
        limits: Sequence[str] = (),
        sensor_noise: Mapping[str, float] | None = None,
    ) -> Planner:
        """Return a policy that plans each action by rollouts of ``horizon`` steps, after value iteration on a grid of
        states, which takes some seconds. ``seed`` is that of the changes of actions that it tries.

        ``set_points`` replaces set points of the declared reward, by coordinate: ``{"level": 12}``. The planner keeps
        ``limits`` such as ``"level<=11"``, besides those of the specification. ``sensor_noise`` has standard deviations
        of measurements, by coordinate: the planner then filters what it measures.

        Raises:
            InvalidInput: the horizon is out of its range, the reward or the model does not support a set point, a limit
                can't be kept, the model does not move a coordinate with sensor noise, or the model or its environment
                does not allow planning.
        """
        try:
            keep = [limit_of(self._spec, text) for text in limits]
        except ValueError as error:
            raise InvalidInput(str(error)) from error
        planner = planner_of(self._model, horizon, seed, set_points, keep, sensor_noise)
        for limit in keep:
            self._require_kept(planner, limit)
        return planner

    def _require_kept(self, planner: Planner, limit: Limit) -> None:
        """Raise ``InvalidInput`` if a planner leaves a limit in each of a few virtual episodes from declared starts."""
        session = self.open(OpenSession(num_envs=TRIED, seed=0, start_box=0.0)).id
        try:
            observation, least = self.reset(session, seed=0).observation, np.full(TRIED, np.inf)
            for _ in range(min(self._spec.time_limit or LONGEST, LONGEST)):
                states = planner.states(observation)
                least = np.minimum(least, distances(self._spec, [limit], states)[:, 0])
                if (least < 0).all():
                    raise InvalidInput(
                        f"limit {limit.name!r}: expected one that plans from the declared starts keep, but each of "
                        f"{TRIED} virtual episodes left it, by up to {-least.min():.3g}: choose a wider limit"
                    )
                observation = self.step(session, planner(observation)).observation
        finally:
            self.close(session)

    def open(self, request: OpenSession) -> SessionView:
        if request.model not in ("latest", VERSION):
            raise UnknownModel(
                f"expected model 'latest' or {VERSION}, the only version of a surrogate without a server, got "
                f"{request.model}: use 'latest'"
            )
        asked = opening(request)
        digest = digest_of("open", asked)
        for live in self._sessions.values():
            if asked.key is not None and live.opened_by is not None and live.opened_by[0] == asked.key:
                return session_view(info_of(check_opening(live, digest)), float("inf"))
        definition = self._model.definition
        session = opened(Open("local", 0, definition, asked), definition, self._model, VERSION, digest)
        self._sessions[session.id] = session
        return session_view(info_of(session), float("inf"))

    def reset(self, session: str, *, seed: int | Sequence[int] | None = None, mask: Bools | None = None) -> ResetResult:
        outcome = self._advance(Reset(session, None, seed, mask))
        assert isinstance(outcome, ResetResult)
        return outcome

    def step(
        self, session: str, action: Floats | Ints, *, mask: Bools | None = None, deviations: bool = False
    ) -> StepResult:
        asked = quick(Step, session=session, seq=None, action=action, mask=mask, stds=deviations, within=None)
        outcome = self._advance(asked)
        assert isinstance(outcome, tuple)
        return outcome[0]

    def rollout(self, session: str, actions: Floats | Ints) -> list[StepResult]:
        outcome = self._advance(Rollout(session, None, np.asarray(actions)))
        assert isinstance(outcome, tuple)
        return list(outcome)

    def rollout_policy(
        self,
        session: str,
        policy: ActingPolicy,
        steps: int,
        *,
        noise: NoiseKey | None = None,
        until: Bools | None = None,
    ) -> PolicyRollout:
        try:
            run = PolicyRun(policy, steps, noise, None if until is None else np.asarray(until, dtype=bool))
        except ValueError as error:
            raise InvalidInput(str(error)) from error
        outcome = self._advance(PolicySteps(session, None, run))
        assert isinstance(outcome, PolicyRollout)
        return outcome

    def submit_occupancy(self, session: str, checkpoint: str) -> SubmittedOccupancy:
        """Return the number of states that the session visited. They are not stored, because a surrogate without a
        server has no design that could use them."""
        return SubmittedOccupancy(checkpoint=checkpoint, states=len(self.visited(session)))

    def visited(self, session: str) -> NDArray[np.float64]:
        """Return the states (v, C) that a session visited. It must have been opened with the option ``occupancy``,
        which records them."""
        return visited_states(self._get(session))

    def close(self, session: str) -> None:
        self._sessions.pop(session, None)

    def _get(self, session: str) -> Session:
        if session not in self._sessions:
            raise UnknownSession(f"expected the id of an open session, got {session!r}: open a new session")
        return self._sessions[session]

    def _advance(self, request: Advance) -> Outcome:
        session, outcome = carried_out(request, self._models, _always, False, self._get(request.session))
        self._sessions[session.id] = session
        return outcome


class _OneModel:
    """Source of models (``engine.requests.Models``) that returns one model for each surrogate and version."""

    def __init__(self, model: DynamicsModel) -> None:
        self._model = model

    def get(self, surrogate: int, version: int, device: torch.device) -> DynamicsModel:
        del surrogate, version, device
        return self._model

    def latest(self, surrogate: int) -> int:
        del surrogate
        return VERSION


def _always() -> None:
    """Do nothing. A server checks before each step of a rollout whether to continue; without a server, none stops."""
