"""Requests and replies of a session engine: frozen data that pickle, without callables.

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
    """A trainer's request for a session. A time limit or penalty of None is the surrogate's; a seed of None
    is drawn."""

    settings: VirtualSettings
    penalty: float | None
    seed: int | None
    model: WantedVersion
    occupancy: bool
    key: str | None


@dataclass(frozen=True)
class SampledRewards:
    """Lowest and highest reward in a surrogate's samples, and the number of samples.

    Virtual rewards are limited to this range, widened as in ``virtual.limits.reward_limits``.
    """

    low: float
    high: float
    samples: int


@dataclass(frozen=True)
class Open:
    """Open a session of a stored surrogate."""

    surrogate: str
    surrogate_id: int
    definition: EnvironmentDefinition
    opening: Opening
    rewards: SampledRewards | None = None  # None: virtual rewards have no limits
    visited: Array | None = None  # (k, C) states of real steps, for a session that starts episodes there


@dataclass(frozen=True, eq=False)
class Reset:
    """New episodes in the lanes of the mask, or in all of them."""

    session: str
    seq: int | None  # the session's next one, or None to give up replay
    seed: Seeds = None
    mask: Bools | None = None  # (N,)
    within: float | None = None  # seconds that the caller waits from now on


@dataclass(frozen=True, eq=False)
class Step:
    """One step of the lanes of the mask, or of all of them."""

    session: str
    seq: int | None
    action: Array  # (N, F), or (N,) where F = 1; a policy's
    mask: Bools | None = None  # (N,)
    deviations: bool = False
    within: float | None = None


@dataclass(frozen=True, eq=False)
class Rollout:
    """T steps with given actions, all or none."""

    session: str
    seq: int | None
    actions: Array  # (T, N, F), or (T, N) where F = 1
    within: float | None = None


@dataclass(frozen=True, eq=False)
class PolicySteps:
    """Steps in which a policy acts in all lanes, all or none."""

    session: str
    seq: int | None
    run: PolicyRun
    within: float | None = None


Advance = Reset | Step | Rollout | PolicySteps


@dataclass(frozen=True, eq=False)
class Reply:
    """The answer to an ``Advance``; a repeat of the request gets the same."""

    seq: int
    outcome: Outcome


@dataclass(frozen=True, eq=False)
class SessionInfo:
    """A session as everyone but its engine knows it."""

    id: str
    surrogate: str
    surrogate_id: int
    definition: EnvironmentDefinition = field(repr=False)
    settings: VirtualSettings
    seed: int
    model: WantedVersion
    versions: Versions  # (N,) the model each lane's episode runs under
    seq: int  # the last one answered
    behind: bool = False  # at a checkpoint, and its client has to send the requests since then again


@dataclass(frozen=True, eq=False)
class Visited:
    """States that a session visited, and how well its model is known there."""

    surrogate_id: int
    states: Array  # (v, C)
    confidence_index: float


@dataclass(frozen=True)
class Saved:
    """A session as bytes, without the definition of its surrogate."""

    id: str
    surrogate: str
    data: bytes = field(repr=False)


@dataclass(frozen=True)
class Restore:
    """Take a saved session back, under the surrogate that has its surrogate's name now."""

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
