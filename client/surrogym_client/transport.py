"""HttpSurrogate: the SurrogatePort over HTTP, in the JSON form of the step routes."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Self, TypeVar
from urllib.parse import quote

import msgspec
import numpy as np
from numpy.typing import NDArray

from surrogym_client.api import Api, check_protocol, new_key, parse
from surrogym_client.connection import Connection, Retries, Timeouts
from surrogym_client.errors import ProtocolMismatch, SessionLost, refused_here
from surrogym_shared import wire
from surrogym_shared.codes import Code
from surrogym_shared.port import Bools, Floats, Ints, ResetResult, StepResult
from surrogym_shared.spec import EnvironmentSpec

__all__ = ["Api", "HttpSurrogate", "Retries", "Timeouts"]


class _ResetBody(msgspec.Struct, forbid_unknown_fields=True):
    """``wire.ResetReply``, decoded without validating each number again."""

    seq: int
    observation: list[list[float]]
    model_version: list[int]


class _StepBody(msgspec.Struct, forbid_unknown_fields=True):
    """``wire.StepReply``, decoded without validating each number again."""

    seq: int
    observation: list[list[float]]
    reward: list[float]
    terminated: list[bool]
    truncated: list[bool]
    model_version: list[int]
    reward_mean: list[float]
    final_lanes: list[int] = []
    final_observation: list[list[float]] = []
    deviation: list[list[float]] | None = None


class _RolloutBody(msgspec.Struct, forbid_unknown_fields=True):
    seq: int
    steps: list[_StepBody]


T = TypeVar("T", _ResetBody, _StepBody, _RolloutBody)


class HttpSurrogate:
    """One surrogate of a server; see ``SurrogatePort`` for the laws it keeps.

    A lost reply, a time-out or a dropped connection is answered by sending the same request with the same
    seq, so a step happens once. A session is an id, not a connection: any HttpSurrogate may go on with
    it, and this one pickles and connects anew. Two can't step one session at once: the second to try gets
    ``SeqConflict``.

    Args:
        url: the server's address; default ``SURROGYM_URL``, then http://127.0.0.1:8000.
        surrogate: name of the surrogate.
        token: bearer token; default ``SURROGYM_TOKEN``.
        timeouts: seconds per kind of request.
        retries: how long to go on after lost connections, lost replies and 503.

    Raises:
        SurrogymClientError: every method; see ``surrogym_client.errors``.

    Example:
        >>> with HttpSurrogate(None, "pendulum") as surrogate:
        ...     session = surrogate.open(OpenSession(num_envs=4, seed=0))
        ...     start = surrogate.reset(session.id)
        ...     result = surrogate.step(session.id, np.zeros((4, 1)))
    """

    def __init__(
        self,
        url: str | None,
        surrogate: str,
        token: str | None = None,
        *,
        timeouts: Timeouts | None = None,
        retries: Retries | None = None,
    ) -> None:
        self.surrogate = surrogate
        self.connection = Connection(url, token, timeouts, retries)
        self._seq: dict[str, int] = {}
        self._spec: EnvironmentSpec | None = None

    def __repr__(self) -> str:
        return f"HttpSurrogate({self.connection.url!r}, {self.surrogate!r})"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.disconnect()

    def disconnect(self) -> None:
        """Close the sockets. Sessions stay, until ``close`` or their expiry; a later request connects anew."""
        self.connection.close()

    def spec(self) -> EnvironmentSpec:
        if self._spec is None:
            self._spec = parse(wire.SurrogateView, self.connection.send("GET", self._route), self._route).spec
        return self._spec

    def open(self, request: wire.OpenSession) -> wire.SessionView:
        if request.idempotency_key is None:
            request = request.model_copy(update={"idempotency_key": new_key()})
        route = f"{self._route}/sessions"
        content = self.connection.send("POST", route, request.model_dump_json().encode())
        view = parse(wire.SessionView, content, route)
        check_protocol(view.protocol, self.connection.url)
        self._seq[view.id] = view.seq
        return view

    def reset(self, session: str, *, seed: int | Sequence[int] | None = None, mask: Bools | None = None) -> ResetResult:
        body: dict[str, Any] = {}
        if seed is not None:
            body["seed"] = int(seed) if isinstance(seed, int | np.integer) else [int(s) for s in seed]
        if mask is not None:
            body["mask"] = np.asarray(mask, dtype=bool).tolist()
        reply = self._in_sequence(session, "reset", body, _RESET, self.connection.timeouts.step)
        return ResetResult(
            observation=np.array(reply.observation, dtype=np.float32),
            model_version=np.array(reply.model_version, dtype=np.int64),
        )

    def step(
        self, session: str, action: Floats | Ints, *, mask: Bools | None = None, deviations: bool = False
    ) -> StepResult:
        body: dict[str, Any] = {"action": _sendable(action)}
        if mask is not None:
            body["mask"] = np.asarray(mask, dtype=bool).tolist()
        if deviations:
            body["deviations"] = True
        return _step_result(self._in_sequence(session, "step", body, _STEP, self.connection.timeouts.step))

    def rollout(self, session: str, actions: Floats | Ints) -> list[StepResult]:
        body = {"actions": _sendable(actions)}
        reply = self._in_sequence(session, "rollout", body, _ROLLOUT, self.connection.timeouts.rollout)
        return [_step_result(step) for step in reply.steps]

    def submit_occupancy(self, session: str, checkpoint: str) -> int:
        route = f"{_session(session)}/occupancy"
        body = wire.SubmitOccupancy(checkpoint=checkpoint).model_dump_json().encode()
        return parse(wire.SubmittedOccupancy, self.connection.send("POST", route, body), route).states

    def close(self, session: str) -> None:
        """End the session; with the last one, the sockets are closed too."""
        self._seq.pop(session, None)
        try:
            with suppress(SessionLost):
                self.connection.send("DELETE", _session(session), retries=Retries(seconds=0))
        finally:
            if not self._seq:
                self.disconnect()

    @property
    def _route(self) -> str:
        return f"/v1/surrogates/{quote(self.surrogate, safe='')}"

    def _in_sequence(
        self, session: str, what: str, body: dict[str, Any], decoder: msgspec.json.Decoder[T], timeout: float
    ) -> T:
        """Send a request that changes the session under its next seq; an error leaves the seq as it was."""
        seq = self._last_seq(session) + 1
        route = f"{_session(session)}/{what}"
        try:
            content = self.connection.send("POST", route, _ENCODER.encode({"seq": seq, **body}), timeout=timeout)
            reply = decoder.decode(content)
        except SessionLost:
            del self._seq[session]
            raise
        except msgspec.DecodeError as error:
            raise ProtocolMismatch(f"unexpected answer of {route}: {error}") from error
        self._seq[session] = reply.seq
        return reply

    def _last_seq(self, session: str) -> int:
        if session not in self._seq:
            route = _session(session)
            self._seq[session] = parse(wire.SessionView, self.connection.send("GET", route), route).seq
        return self._seq[session]


_ENCODER = msgspec.json.Encoder()
_RESET = msgspec.json.Decoder(_ResetBody)
_STEP = msgspec.json.Decoder(_StepBody)
_ROLLOUT = msgspec.json.Decoder(_RolloutBody)


def _session(session: str) -> str:
    return f"/v1/sessions/{quote(session, safe='')}"


def _sendable(action: NDArray[Any]) -> Any:
    """Actions as nested lists; what JSON can't carry is refused here, the rest is the server's to judge."""
    array = np.asarray(action)
    if array.dtype.kind not in "biuf":
        raise refused_here(Code.INVALID_REQUEST, f"action: expected an array of numbers, got dtype {array.dtype}")
    if not np.isfinite(array).all():
        place = np.argwhere(~np.isfinite(array))[0].tolist()
        value = array[tuple(place)]
        raise refused_here(Code.INVALID_REQUEST, f"action{place}: expected a finite number, got {value}")
    return array.tolist()


def _step_result(body: _StepBody) -> StepResult:
    observation = np.array(body.observation, dtype=np.float32)
    final = np.array(body.final_observation, dtype=np.float32)
    return StepResult(
        observation=observation,
        reward=np.array(body.reward, dtype=np.float64),
        terminated=np.array(body.terminated, dtype=bool),
        truncated=np.array(body.truncated, dtype=bool),
        final_lanes=np.array(body.final_lanes, dtype=np.int64),
        final_observation=final.reshape(len(body.final_lanes), observation.shape[-1]),
        model_version=np.array(body.model_version, dtype=np.int64),
        reward_mean=np.array(body.reward_mean, dtype=np.float64),
        deviation=None if body.deviation is None else np.array(body.deviation, dtype=np.float64),
    )
