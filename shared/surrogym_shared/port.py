"""SurrogatePort: what a trainer needs of a surrogate, whatever carries it.

JSON and frames over HTTP, the stream of frames and the in-process surrogate implement it; one suite tests them all.
Arrays are numpy: observation (N, D) float32, action (N, F) or (N,), reward (N,) float64, flags (N,) bool.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import OpenSession, SessionView, SubmittedOccupancy

Floats = NDArray[np.floating[Any]]
Bools = NDArray[np.bool_]
Ints = NDArray[np.integer[Any]]
T = TypeVar("T")


@dataclass(frozen=True)
class ResetResult:
    observation: Floats  # (N, D)
    model_version: Ints  # (N,)


@dataclass(frozen=True)
class StepResult:
    observation: Floats  # (N, D)
    reward: Floats  # (N,), penalised
    terminated: Bools  # (N,)
    truncated: Bools  # (N,)
    final_lanes: Ints  # (K,) lanes that ended and were reset within this step
    final_observation: Floats  # (K, D)
    model_version: Ints  # (N,)
    reward_mean: Floats  # (N,), before the penalty
    deviation: Floats | None  # (N, O) when asked for
    untrusted: Bools | None = None  # (N,) lanes truncated for leaving the trusted range; None in a session without one


def quick(kind: type[T], **fields: Any) -> T:
    """A frozen dataclass of all its fields, at half the cost of its constructor, which every step pays twice."""
    made = object.__new__(kind)
    made.__dict__.update(fields)
    return made


@runtime_checkable
class SurrogatePort(Protocol):
    """One surrogate, seen by a trainer.

    Laws: a step happens once, however often the transport repeats it; a repeat gives the same reply, bit for bit;
    results of one session depend on its seed and its requests alone; an error has the same class name in every
    implementation's tree (``surrogym_client.errors``, ``surrogym_server.errors``).
    """

    def spec(self) -> EnvironmentSpec:
        """The specification of the original environment."""
        ...

    def open(self, request: OpenSession) -> SessionView:
        """Open a session of N lanes."""
        ...

    def reset(self, session: str, *, seed: int | Sequence[int] | None = None, mask: Bools | None = None) -> ResetResult:
        """Start new episodes in all lanes, or those of the mask."""
        ...

    def step(
        self, session: str, action: Floats | Ints, *, mask: Bools | None = None, deviations: bool = False
    ) -> StepResult:
        """Step all lanes, or those of the mask."""
        ...

    def rollout(self, session: str, actions: Floats | Ints) -> list[StepResult]:
        """Step T times with actions (T, N, F), in one request."""
        ...

    def submit_occupancy(self, session: str, checkpoint: str) -> SubmittedOccupancy:
        """Store the states this session visited under a name, for the design to weigh its queries by, and say how well
        the model is known there."""
        ...

    def close(self, session: str) -> None:
        """End the session; closing twice is harmless."""
        ...
