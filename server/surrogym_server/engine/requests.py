"""Requests and replies of a session engine: frozen dataclasses that can be pickled.

Shapes: N lanes, C coordinates, F action entries, T steps.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from surrogym_server.engine.session import Outcome, Seeds, Session, Versions, WantedVersion
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.virtual import VirtualSettings
from surrogym_shared.acting import PolicyRun

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Opening:
    """Settings with which a caller opens a session.

    A time limit or penalty of None means that of the surrogate's specification, a seed of None a random seed.
    """

    settings: VirtualSettings
    penalty: float | None
    seed: int | None
    model: WantedVersion
    occupancy: bool
    key: str | None


@dataclass(frozen=True)
class SampledRewards:
    """Lowest and highest reward in a surrogate's samples, and the number of the samples.

    Rewards of virtual steps are limited to this range, widened by ``virtual.limits.reward_limits``.
    """

    low: float
    high: float
    samples: int


@dataclass(frozen=True)
class Open:
    """Request to open a session of a stored surrogate."""

    surrogate: str
    surrogate_id: int
    definition: EnvironmentDefinition
    opening: Opening
    rewards: SampledRewards | None = None  # range of the samples' rewards, which limits virtual ones; None: no limits
    visited: Array | None = None  # (k, C) coordinates of k real steps, at which the session may start episodes


@dataclass(frozen=True, eq=False)
class Reset:
    """Request to begin new episodes in the lanes that ``mask`` selects, or in all lanes of a session."""

    session: str
    seq: int | None  # the session's next sequence number; None: the engine can't recognise a repeat of the request
    seed: Seeds = None
    mask: Bools | None = None  # (N,) which of the N lanes the request resets or steps; None: all
    within: float | None = None  # the caller waits at most this many seconds for the reply; None: no limit


@dataclass(frozen=True, eq=False)
class Step:
    """Request for one step in the lanes that ``mask`` selects, or in all lanes of a session."""

    session: str
    seq: int | None
    action: Array  # (N, F) a policy's action of F entries for each of N lanes; also (N,) if F = 1
    mask: Bools | None = None  # (N,) which of the N lanes the request resets or steps; None: all
    stds: bool = False
    within: float | None = None


@dataclass(frozen=True, eq=False)
class Rollout:
    """Request for T steps of all lanes of a session with given actions. If a step fails, none counts as taken."""

    session: str
    seq: int | None
    actions: Array  # (T, N, F) a policy's actions for each of T steps and N lanes; also (T, N) if F = 1
    within: float | None = None


@dataclass(frozen=True, eq=False)
class PolicySteps:
    """Request for steps of all lanes of a session with actions that a policy chooses. If a step fails, none counts as
    taken."""

    session: str
    seq: int | None
    run: PolicyRun
    within: float | None = None


Advance = Reset | Step | Rollout | PolicySteps


@dataclass(frozen=True, eq=False)
class Reply:
    """Answer to a reset, step or rollout. A repeat of the request gets the same answer."""

    seq: int
    outcome: Outcome


@dataclass(frozen=True, eq=False)
class SessionInfo:
    """Description of a session: its surrogate, its settings, and the versions of its models."""

    id: str
    surrogate: str
    surrogate_id: int
    definition: EnvironmentDefinition = field(repr=False)
    settings: VirtualSettings
    seed: int
    model: WantedVersion
    versions: Versions  # (N,) version of the model that computes the current episode of each lane
    seq: int  # sequence number of the last request that the session has answered; 0 before the first
    # Whether the session was restored from an older checkpoint, so that the client has to repeat its last requests.
    behind: bool = False


@dataclass(frozen=True, eq=False)
class Visited:
    """States that a session visited, and the model's confidence index over them."""

    surrogate_id: int
    states: Array  # (v, C) coordinates of v visited states, a random sample if there were too many
    confidence_index: float


@dataclass(frozen=True)
class Saved:
    """A saved session as bytes, without the environment's definition, which is stored with the surrogate."""

    id: str
    surrogate: str
    data: bytes = field(repr=False)


@dataclass(frozen=True)
class Restore:
    """Request to restore a saved session.

    ``surrogate_id`` and ``definition`` are those of the surrogate that now has the name in ``saved``.
    """

    saved: Saved
    surrogate_id: int
    definition: EnvironmentDefinition = field(repr=False)


def info_of(session: Session) -> SessionInfo:
    return SessionInfo(
        id=session.id,
        surrogate=session.surrogate,
        surrogate_id=session.surrogate_id,
        definition=session.definition,
        settings=session.settings,
        seed=session.seed,
        model=session.model,
        versions=session.versions,
        seq=session.seq,
    )
