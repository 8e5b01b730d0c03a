"""Conversion of a session to bytes and back: an NPZ file with a JSON header. Nothing is pickled."""

from __future__ import annotations

import io
import json
import zlib
from dataclasses import asdict, fields, replace
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_server.engine.occupancy import Reservoir
from surrogym_server.engine.session import Answer, Fingerprint, Outcome, Session
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import Damaged, InvalidInput, UnknownSession
from surrogym_server.tensors import to_device
from surrogym_server.virtual import LaneState, Residual, VirtualSettings
from surrogym_shared.port import PolicyRollout, ResetResult, StepResult

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
