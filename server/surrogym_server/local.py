"""LocalSurrogate: a surrogate stepped in this process, for those who have the [server] extra. No server, no FastAPI."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from surrogym_server.convert import opening, session_view, stored_definition
from surrogym_server.engine.rollouts import roll, roll_policy
from surrogym_server.engine.session import (
    Session,
    check_opening,
    digest_of,
    open_session,
    reset_session,
    step_session,
)
from surrogym_server.environment.actions import policy_actions
from surrogym_server.errors import InvalidInput, NotReset, UnknownModel, UnknownSession
from surrogym_server.models.files import from_bytes
from surrogym_server.models.port import DynamicsModel
from surrogym_server.services.sessions import resolved
from surrogym_server.virtual import in_fastest_form
from surrogym_shared.acting import ActingPolicy, NoiseKey, PolicyRun
from surrogym_shared.port import Bools, Floats, Ints, PolicyRollout, ResetResult, StepResult
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.surrogate_file import SurrogateFile
from surrogym_shared.wire import OpenSession, SessionView, SubmittedOccupancy

VERSION = 1


class LocalSurrogate:
    """One model behind the SurrogatePort; see its laws. Errors are those of ``surrogym_server.errors``.

    Args:
        spec: the original environment.
        model: a model of it; it is version 1, and the latest.

    Examples:
        >>> surrogate = LocalSurrogate.load("spec.json", "model.safetensors")
        >>> env = SurrogateVecEnv.from_port(surrogate, num_envs=16)
    """

    def __init__(self, spec: EnvironmentSpec, model: DynamicsModel) -> None:
        self._spec = spec
        self._model = model
        self._sessions: dict[str, Session] = {}

    @classmethod
    def load(cls, spec: str | Path, model: str | Path) -> Self:
        """Read a specification (JSON) and a model (safetensors) as the server exports them.

        Raises:
            OSError: a file that can't be read.
            ValueError: a specification that contradicts itself.
            InvalidInput: not a model of it.
        """
        read = EnvironmentSpec.model_validate_json(Path(spec).read_bytes())
        return cls.from_bytes(read, Path(model).read_bytes())

    @classmethod
    def from_bytes(cls, spec: EnvironmentSpec, model: bytes) -> Self:
        """A surrogate of a specification and a model's file. Raises ``InvalidInput``: no model of it."""
        return cls(spec, from_bytes(stored_definition(spec), model))

    @classmethod
    def from_file(cls, path: str | Path) -> Self:
        """Read a whole surrogate from the one file that ``surrogym export`` writes.

        Raises:
            OSError: the file can't be read.
            NotASurrogateFile: it is none.
            InvalidInput: its model is none of its specification.
        """
        file = SurrogateFile.load(path)
        return cls.from_bytes(file.spec, file.model)

    def spec(self) -> EnvironmentSpec:
        return self._spec

    @property
    def model(self) -> DynamicsModel:
        """What the steps are computed with."""
        return self._model

    def open(self, request: OpenSession) -> SessionView:
        if request.model not in ("latest", VERSION):
            raise UnknownModel(f"expected model 'latest' or {VERSION}, got {request.model}")
        asked, definition = opening(request), self._model.definition
        digest = digest_of("open", asked)
        for live in self._sessions.values():
            if asked.key is not None and live.opened_by is not None and live.opened_by[0] == asked.key:
                return session_view(check_opening(live, digest), float("inf"))
        session = open_session(
            secrets.token_urlsafe(8),
            "local",
            definition,
            in_fastest_form(resolved(asked, definition), self._model),
            seed=secrets.randbits(63) if asked.seed is None else asked.seed,
            model=asked.model,
            version=VERSION,
            occupancy=asked.occupancy,
            opened_by=None if asked.key is None else (asked.key, digest),
        )
        self._sessions[session.id] = session
        return session_view(session, float("inf"))

    def reset(self, session: str, *, seed: int | Sequence[int] | None = None, mask: Bools | None = None) -> ResetResult:
        self._sessions[session], result = reset_session(self._get(session), seed, mask, VERSION)
        return result

    def step(
        self, session: str, action: Floats | Ints, *, mask: Bools | None = None, deviations: bool = False
    ) -> StepResult:
        live = self._get(session)
        u = policy_actions(live.definition.action, action, live.settings.num_envs)
        self._sessions[session], result = step_session(live, u, mask, deviations, self._version, VERSION)
        return result

    def rollout(self, session: str, actions: Floats | Ints) -> list[StepResult]:
        self._sessions[session], results = roll(self._get(session), np.asarray(actions), self._step)
        return list(results)

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
        self._sessions[session], result = roll_policy(self._get(session), run, self._step)
        return result

    def submit_occupancy(self, session: str, checkpoint: str) -> SubmittedOccupancy:
        """There is no design here to weigh; says how many states there are, and keeps none."""
        states = len(self.visited(session))
        if not states:
            raise NotReset("this session has visited no state yet: reset and step it first")
        return SubmittedOccupancy(checkpoint=checkpoint, states=states)

    def visited(self, session: str) -> NDArray[np.float64]:
        """The states that a session opened with occupancy visited, (v, C)."""
        visited = self._get(session).visited
        if visited is None:
            raise InvalidInput("expected a session opened with occupancy=true, got one without")
        return visited.states

    def close(self, session: str) -> None:
        self._sessions.pop(session, None)

    def _get(self, session: str) -> Session:
        if session not in self._sessions:
            raise UnknownSession(f"no session {session!r}: open a new one")
        return self._sessions[session]

    def _step(self, session: Session, u: NDArray[np.float64]) -> tuple[Session, StepResult]:
        return step_session(session, u, None, False, self._version, VERSION)

    def _version(self, version: int) -> DynamicsModel:
        del version  # there is one
        return self._model
