"""One round of the design as a picklable job on arrays: fit all outputs, judge fidelity, choose the next queries.

It is a pure function of its job, so it runs in a process of its own, and the same job gives the same result.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Verdict = Literal["continue", "ready", "over_budget"]


@dataclass(frozen=True)
class DesignJob:
    """What one round needs. ``spec`` and ``state`` are JSON-able; ``previous`` is the last model, for a warm start."""

    spec: dict[str, Any]
    coordinates: Array  # (n, C) samples so far, in order of arrival
    action: Array  # (n, F)
    next_coordinates: Array  # (n, C)
    reward: Array  # (n,)
    terminated: NDArray[np.bool_]  # (n,)
    state: dict[str, Any]  # DesignState; {} before the first round
    budget: int  # real steps the design may take in all
    target: float  # confidence index
    previous: bytes | None = None
    pending_coordinates: Array | None = None  # (p, C) queries asked and not yet answered
    pending_action: Array | None = None  # (p, F)
    extra_queries: int = 0  # asked for with improve: chosen whatever the verdict
    occupancy: Array | None = None  # (m, C) states that policies visited
    threads: int = 1


@dataclass(frozen=True)
class DesignResult:
    """``model`` is complete (safetensors with a JSON header): loading it recomputes nothing."""

    model: bytes
    description: dict[str, Any]
    fidelity: dict[str, Any]  # the fields of wire.Fidelity
    data_hash: str
    state: dict[str, Any]
    verdict: Verdict
    seconds: float
    query_coordinates: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (m, C)
    query_action: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (m, F)


def initial_queries(spec: dict[str, Any], budget: int) -> tuple[dict[str, Any], Array, Array]:
    """The Latin hypercube of the first round: (state, coordinates (m, C), action (m, F))."""
    raise NotImplementedError


def run_design_job(job: DesignJob) -> DesignResult:
    """Fit, judge, choose."""
    raise NotImplementedError
