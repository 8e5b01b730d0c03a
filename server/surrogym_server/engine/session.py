"""A session as a frozen, serialisable object, and the pure functions that reset, step and save it.

A saved session is an NPZ file with a JSON header. Nothing is pickled.

Shapes: N lanes, D observation entries, F action entries, C coordinates.
"""

from __future__ import annotations

import hashlib
import io
import json
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Literal
from zipfile import BadZipFile

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import Damaged, IdempotencyConflict, InvalidInput, SeqConflict, UnknownSession
from surrogym_server.models.port import DynamicsModel
from surrogym_server.tensors import to_device
from surrogym_server.virtual import LaneState, LaneTransition, Residual, VirtualSettings, reset, step, within
from surrogym_shared.port import PolicyRollout, ResetResult, StepResult, quick

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]
Versions = NDArray[np.int64]
WantedVersion = Literal["latest"] | int
ModelOf = Callable[[int], DynamicsModel]
Seeds = int | Sequence[int] | None
Outcome = ResetResult | tuple[StepResult, ...] | PolicyRollout

RESULT_BYTES = 2_048  # estimated memory of the array objects in the result of one step, without the arrays' numbers
LANE_BYTES = 48  # estimated memory of one lane's numbers in the result of one step, without observation and action


class Fingerprint:
    """Content hash of a request, by which a repeat is recognised; equal on every transport.

    It is computed on first use, because most requests are never repeated, and computing it takes as long as a small
    step.
    """

    __slots__ = ("_digest", "_parts")

    def __init__(self, *parts: object, digest: str | None = None) -> None:
        """Keep ``digest``, the hash of a request, or if it is None the values ``parts``, from which the hash is
        computed later; these must not change."""
        self._parts = parts
        self._digest = digest

    @property
    def digest(self) -> str:
        if self._digest is None:
            operation, *parts = self._parts
            self._digest = digest_of(str(operation), *parts)
        return self._digest

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Fingerprint) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)


@dataclass(frozen=True)
class Answer:
    """The last answer of a session, kept so that a repeat of its request gets the same answer."""

    seq: int
    request: Fingerprint
    outcome: Outcome


@dataclass(frozen=True)
class Session:
    """One trainer's virtual environment, with all state on which its next step depends."""

    id: str
    surrogate: str
    definition: EnvironmentDefinition
    settings: VirtualSettings
    seed: int
    model: WantedVersion
    lanes: LaneState
    versions: Versions  # (N,) version of the model that computes the current episode of each lane
    answer: Answer | None = None
    visited: Reservoir | None = None
    # Idempotency key and content hash of the request that opened the session; None if the request had no key.
    opened_by: tuple[str, str] | None = None
    surrogate_id: int = 0  # id of the session's surrogate in the database; 0 in a program without a database

    @property
    def nbytes(self) -> int:
        """Approximate memory of the session's lanes and its stored last answer, in bytes."""
        outcome = None if self.answer is None else self.answer.outcome
        return self.lanes.nbytes + self.answer_bytes(1 if outcome is None else steps_of(outcome))

    def answer_bytes(self, steps: int) -> int:
        """Return the approximate memory, in bytes, of the stored answer to a request with this number of steps."""
        lane = 8 * (len(self.definition.observation_names) + self.definition.action.size) + LANE_BYTES
        return steps * (RESULT_BYTES + self.settings.num_envs * lane)

    @property
    def seq(self) -> int:
        """Sequence number of the last answered request."""
        return 0 if self.answer is None else self.answer.seq


def steps_of(outcome: Outcome) -> int:
    """Return the number of steps that a request has taken, from its outcome; a reset counts as one step."""
    return 1 if isinstance(outcome, ResetResult) else len(outcome)


def replay(session: Session, seq: int | None, request: Fingerprint) -> Answer | None:
    """Return the last answer of a session if the request repeats its last request, or None if the request is the next
    one.

    Raises:
        SeqConflict: the sequence number ``seq`` is neither the last nor the next one, or it is the last one but the
            request has another content hash.
    """
    if seq is None or seq == session.seq + 1:
        return None
    answer = session.answer
    if answer is not None and seq == answer.seq and request == answer.request:
        return answer
    repeated = " with another body" if answer is not None and seq == answer.seq else ""
    raise SeqConflict(
        f"expected seq {session.seq + 1}, got {seq}{repeated}: number the requests of a session 1, 2, 3, ...",
        expected=session.seq + 1,
    )


def answered(session: Session, request: Fingerprint, outcome: Outcome) -> tuple[Session, Answer]:
    """Store the outcome of a request as the session's last answer. Return the new session and the answer."""
    answer = Answer(session.seq + 1, request, outcome)
    return _with(session, answer=answer), answer


def reset_session(session: Session, seed: Seeds, mask: Bools | None, latest: int) -> tuple[Session, ResetResult]:
    """Start new episodes in the lanes of ``mask`` (None: in all lanes), under the model version ``latest``. With a
    ``seed``, these are the episodes 0 of this seed; if it is None, each lane begins its next episode."""
    lanes, observation = reset(session.definition, session.settings, session.lanes, seed, mask)
    lanes_reset = np.ones(session.settings.num_envs, dtype=bool) if mask is None else mask
    versions = np.where(lanes_reset, latest, session.versions)
    session = replace(session, lanes=lanes, versions=versions)
    return _with_visits(session, lanes_reset), ResetResult(observation, versions)


def step_session(
    session: Session,
    action: Floats,
    mask: Bools | None,
    stds: bool,
    model_of: ModelOf,
    latest: int,
) -> tuple[Session, StepResult]:
    """Step the lanes that ``mask`` (N,) selects (None: all lanes) with actions (N, F) in the form that the model takes.

    Each lane steps under the model version of its episode. A lane that begins a new episode in this step continues
    under the version ``latest``. ``model_of`` returns the model of a version. With ``stds``, the result has the
    standard deviations of the model's outputs.
    """
    if mask is not None:
        _check_mask(mask, session.settings.num_envs)
    lanes, transition = _step_versions(session, action, mask, stds, model_of)
    if session.settings.reward_limits is not None:
        transition = within(session.settings.reward_limits, transition)
    versions = np.where(transition.reset_lanes, latest, session.versions)
    session = _with(session, lanes=lanes, versions=versions)
    return session if session.visited is None else _with_visits(session, mask), _result(transition, versions)


def _step_versions(
    session: Session, action: Floats, mask: Bools | None, stds: bool, model_of: ModelOf
) -> tuple[LaneState, LaneTransition]:
    first = session.versions[0]
    if (session.versions == first).all():
        return step(model_of(int(first)), session.settings, session.lanes, action, mask, stds)
    lanes, parts = session.lanes, []
    for version in np.unique(session.versions):
        index = np.flatnonzero(session.versions == version)
        part, transition = step(
            model_of(int(version)),
            session.settings,
            session.lanes.take(index),
            action[index],
            None if mask is None else mask[index],
            stds,
        )
        lanes = lanes.put(index, part)
        parts.append((index, transition))
    return lanes, _join(parts)


def _join(parts: Sequence[tuple[NDArray[np.intp], LaneTransition]]) -> LaneTransition:
    """Join the results of a step of several sets of lanes to one result for all lanes. Each part consists of the
    indices of its lanes and their results, and each lane is in exactly one part."""
    order = np.argsort(np.concatenate([index for index, _ in parts]))
    final_lanes = np.concatenate([index[t.final_lanes] for index, t in parts])
    final_order = np.argsort(final_lanes)
    joined: dict[str, Any] = {
        "final_lanes": final_lanes[final_order],
        "final_observation": np.concatenate([t.final_observation for _, t in parts])[final_order],
    }
    for name in vars(parts[0][1]).keys() - joined.keys():
        arrays = [array for _, t in parts if (array := getattr(t, name)) is not None]
        joined[name] = np.concatenate(arrays)[order] if arrays else None
    return LaneTransition(**joined)


def _result(transition: LaneTransition, versions: Versions) -> StepResult:
    return quick(
        StepResult,
        observation=transition.observation,
        reward=transition.reward,
        terminated=transition.terminated,
        truncated=transition.truncated,
        final_lanes=transition.final_lanes,
        final_observation=transition.final_observation,
        model_version=versions,
        reward_mean=transition.reward_mean,
        deviation=transition.std,
        untrusted=transition.untrusted,
        left=transition.left,
    )


def _with_visits(session: Session, mask: Bools | None) -> Session:
    if session.visited is None:
        return session
    states = session.lanes.q.cpu().numpy()
    return replace(session, visited=session.visited.visit(states if mask is None else states[mask]))


def _check_mask(mask: Bools, num_envs: int) -> None:
    if mask.shape != (num_envs,):
        raise InvalidInput(f"mask: expected {num_envs} entries, one for each lane, got {len(mask)}")


def check_opening(session: Session, digest: str) -> Session:
    """Return the session if the request that opened it had the content hash ``digest``.

    Raises:
        IdempotencyConflict: the session was opened with other settings under the same idempotency key.
    """
    if session.opened_by is None or session.opened_by[1] != digest:
        raise IdempotencyConflict(
            "idempotency key: expected a new one, got one with which a session with other settings was opened: use "
            "another key"
        )
    return session


def digest_of(operation: str, *parts: object) -> str:
    """Return the SHA-256 hash of a request, from its operation and its values; equal on every transport."""
    return hashlib.sha256(b"|".join([operation.encode(), *map(_bytes_of, parts)])).hexdigest()


def _bytes_of(part: object) -> bytes:
    if isinstance(part, np.ndarray):
        return f"{part.dtype.str}{part.shape}".encode() + part.tobytes()
    return repr(part).encode()


def _with(session: Session, **changes: Any) -> Session:
    """Return a copy of a session with some fields changed.

    This takes a fifth of the time of ``dataclasses.replace``, and each step does it twice.
    """
    changed = object.__new__(Session)
    changed.__dict__.update(session.__dict__, **changes)
    return changed


FORMAT = 2
MALFORMED = (BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, ValueError, LookupError, TypeError)
# Fields of a step's result whose length differs from step to step, so that the steps of a rollout can't be stacked.
RAGGED = ("final_lanes", "final_observation")

Arrays = dict[str, NDArray[Any]]


def session_to_bytes(session: Session) -> bytes:
    """Convert a session to bytes, without the environment's definition, which is stored with the surrogate."""
    header: dict[str, Any] = {
        "format": FORMAT,
        "id": session.id,
        "surrogate": session.surrogate,
        "surrogate_id": session.surrogate_id,
        "settings": asdict(replace(session.settings, visited=None)),
        "seed": session.seed,
        "model": session.model,
        "opened_by": session.opened_by,
    }
    arrays: Arrays = {"versions": session.versions, **_prefixed("lanes", session.lanes.to_arrays())}
    if session.settings.visited is not None:
        arrays["starts"] = session.settings.visited.cpu().numpy()
    if session.answer is not None:
        header["answer"] = {"seq": session.answer.seq, "digest": session.answer.request.digest}
        arrays |= _outcome_arrays(session.answer.outcome)
    if session.visited is not None:
        header["visited"] = {"seed": session.visited.seed, "seen": session.visited.visits}
        arrays |= _prefixed("visited", {"states": session.visited.states, "priority": session.visited.priority})
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def session_from_bytes(definition: EnvironmentDefinition, data: bytes, surrogate_id: int = 0) -> Session:
    """Restore a session that ``session_to_bytes`` saved. Its next step is the same, bit for bit.

    Args:
        definition: environment definition of the session's surrogate.
        data: the saved bytes.
        surrogate_id: id of the surrogate that now has the name of the session's surrogate.

    Raises:
        InvalidInput: the session was saved by another version of this program.
        UnknownSession: the session's surrogate was deleted, and another surrogate has its name.
        Damaged: the bytes have changed; each array is stored with a checksum.
    """
    try:
        return _read(definition, data, surrogate_id)
    except MALFORMED as error:
        raise Damaged(
            f"expected a saved session, got {len(data)} bytes that are damaged: {error}; open a new session"
        ) from error


def _read(definition: EnvironmentDefinition, data: bytes, surrogate_id: int) -> Session:
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        arrays: Arrays = {name: file[name] for name in file.files}
    header = json.loads(arrays["header"].tobytes())
    if header["format"] != FORMAT:
        raise InvalidInput(
            f"expected a session saved in format {FORMAT}, got format {header['format']}, which is of another version "
            "of surrogym: open a new session"
        )
    if header["surrogate_id"] != surrogate_id:
        raise UnknownSession(
            f"session {header['id']!r} can't be restored, because its surrogate was deleted: open a new session"
        )
    opened_by = header["opened_by"]
    return Session(
        id=header["id"],
        surrogate=header["surrogate"],
        definition=definition,
        settings=_settings(header["settings"], arrays.get("starts"), definition.device),
        seed=header["seed"],
        model=header["model"],
        lanes=to_device(LaneState.from_arrays(_unprefixed("lanes", arrays)), definition.device),
        versions=arrays["versions"],
        answer=_answer(header, arrays),
        visited=_reservoir(header, arrays),
        opened_by=None if opened_by is None else (opened_by[0], opened_by[1]),
        surrogate_id=surrogate_id,
    )


def _settings(saved: dict[str, Any], starts: NDArray[Any] | None, device: torch.device) -> VirtualSettings:
    limits, noise, residual = saved["reward_limits"], saved["sensor_noise"], saved.get("residual")
    tuples = {
        "reward_limits": None if limits is None else (limits[0], limits[1]),
        "sensor_noise": tuple((name, std) for name, std in noise),
        "set_points": tuple((name, value) for name, value in saved.get("set_points", ())),
        "residual": None if residual is None else Residual.from_saved(residual),
    }
    states = None if starts is None else torch.from_numpy(starts).to(device)
    return VirtualSettings(**{**saved, **tuples, "visited": states})


def _answer(header: dict[str, Any], arrays: Arrays) -> Answer | None:
    if (entry := header.get("answer")) is None:
        return None
    outcome: Outcome
    if reset := _unprefixed("reset", arrays):
        outcome = ResetResult(**reset)
    elif policy := _unprefixed("policy", arrays):
        fields: dict[str, Any] = {"log_probability": None, **policy}
        outcome = PolicyRollout(**fields)
    else:
        outcome = _steps(_unprefixed("steps", arrays))
    return Answer(entry["seq"], Fingerprint(digest=entry["digest"]), outcome)


def _reservoir(header: dict[str, Any], arrays: Arrays) -> Reservoir | None:
    if (entry := header.get("visited")) is None:
        return None
    return Reservoir(entry["seed"], entry["seen"], arrays["visited/states"], arrays["visited/priority"])


def _outcome_arrays(outcome: Outcome) -> Arrays:
    if isinstance(outcome, ResetResult):
        return _prefixed("reset", _fields(outcome))
    if isinstance(outcome, PolicyRollout):
        return _prefixed("policy", _fields(outcome))
    rows = [_fields(step) for step in outcome]
    arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0] if name not in RAGGED}
    arrays |= {name: np.concatenate([row[name] for row in rows]) for name in RAGGED}
    arrays["final_counts"] = np.array([len(row["final_lanes"]) for row in rows])
    return _prefixed("steps", arrays)


def _steps(arrays: Arrays) -> tuple[StepResult, ...]:
    ends = np.cumsum(arrays.pop("final_counts"))[:-1]
    ragged = {name: np.split(arrays.pop(name), ends) for name in RAGGED}
    count = len(arrays["reward"])
    none = [None] * count
    columns: dict[str, Any] = {"deviation": none, "untrusted": none, "left": none, **arrays, **ragged}
    return tuple(StepResult(**{name: column[t] for name, column in columns.items()}) for t in range(count))


def _fields(result: ResetResult | StepResult | PolicyRollout) -> Arrays:
    values = {field.name: getattr(result, field.name) for field in fields(result)}
    return {name: value for name, value in values.items() if value is not None}


def _prefixed(prefix: str, arrays: Arrays) -> Arrays:
    return {f"{prefix}/{name}": array for name, array in arrays.items()}


def _unprefixed(prefix: str, arrays: Arrays) -> Arrays:
    start = f"{prefix}/"
    return {name.removeprefix(start): array for name, array in arrays.items() if name.startswith(start)}


Array = NDArray[np.float64]

CAPACITY = 4_096


@dataclass(frozen=True)
class Reservoir:
    """Uniform random sample of at most ``CAPACITY`` of the states that a session visited: those of highest priority.

    The priority of the t-th visit is the t-th random number of a generator with the key ``seed``. So the sample does
    not depend on how the visits were divided into requests.
    """

    seed: int
    visits: int = 0  # number of states that the session has visited so far, each visit counted
    # (m, C) coordinates of the m sampled ones of the visited states.
    states: Array = field(default_factory=lambda: np.zeros((0, 0)))
    # (m,) random priority of each sampled state; the sample keeps the states with the highest ones.
    priority: Array = field(default_factory=lambda: np.zeros(0))

    def visit(self, states: Array) -> Reservoir:
        """Return a reservoir that also takes into account n further visits to ``states`` (n, C), in order."""
        priority = _priorities(self.seed, self.visits, len(states))
        full = len(self.priority) == CAPACITY
        candidates = np.flatnonzero(priority > self.priority.min()) if full else np.arange(len(states))
        visits = self.visits + len(states)
        if len(candidates) == 0:
            return Reservoir(self.seed, visits, self.states, self.priority)
        before = self.states if len(self.states) else np.zeros((0, states.shape[1]))
        joined_states = np.concatenate([before, states[candidates]])
        priorities = np.concatenate([self.priority, priority[candidates]])
        rows = np.sort(np.argsort(priorities, kind="stable")[-CAPACITY:])
        return Reservoir(self.seed, visits, joined_states[rows], priorities[rows])


def _priorities(seed: int, first: int, count: int) -> Array:
    """Return the random numbers with the indices ``first`` to ``first + count - 1`` of a generator with the key
    ``seed``, (count,).

    The Philox generator can only start at a multiple of four, so up to three numbers before ``first`` are dropped.
    """
    block, offset = divmod(first, 4)
    generator = np.random.Generator(np.random.Philox(key=seed, counter=block))
    return generator.random(offset + count)[offset:]
