"""Specification of an original environment (``EnvironmentSpec``): what is known of it before the first query.

Symbols: coordinates ``q`` (n, C), observation ``o`` (n, D), action ``u`` (n, F). A specification is data. Adapters make
it for known environments, and people write it as JSON or Python for their own. No part of it is ever evaluated as code.
A contradiction raises an error that says what was expected and what came.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from surrogym_shared.kinds import Access
from surrogym_shared.lazy import on_first_use
from surrogym_shared.spec.actions import Action, BoxAction, DiscreteAction, MultiDiscreteAction
from surrogym_shared.spec.base import (
    LONGEST_ROLLOUT,
    MAX_DIMENSIONS,
    MAX_ROLLOUT_QUERY,
    MOST_HORIZON,
    MOST_PLANNED,
    MOST_PLANNED_ENTRIES,
    REWARD,
    ends_of,
)
from surrogym_shared.spec.coordinates import Bounds, Coordinate, Fixed, Lag, Normal, Uniform, limits
from surrogym_shared.spec.environment import AcquisitionChoice, Choice, Design, EnvironmentSpec, ModelChoice
from surrogym_shared.spec.rewards import DeclaredReward, Quantity, Reward, RewardTerm, Success
from surrogym_shared.spec.safety import Limit, Limits
from surrogym_shared.spec.terms import AllOf, Inequality, ObservationEntry, Part, Term

if TYPE_CHECKING:
    from surrogym_shared.spec.history import with_history

__all__ = [
    "LONGEST_ROLLOUT",
    "MAX_DIMENSIONS",
    "MAX_ROLLOUT_QUERY",
    "MOST_HORIZON",
    "MOST_PLANNED",
    "MOST_PLANNED_ENTRIES",
    "REWARD",
    "Access",
    "AcquisitionChoice",
    "Action",
    "AllOf",
    "Bounds",
    "BoxAction",
    "Choice",
    "Coordinate",
    "DeclaredReward",
    "Design",
    "DiscreteAction",
    "EnvironmentSpec",
    "Fixed",
    "Inequality",
    "Lag",
    "Limit",
    "Limits",
    "ModelChoice",
    "MultiDiscreteAction",
    "Normal",
    "ObservationEntry",
    "Part",
    "Quantity",
    "Reward",
    "RewardTerm",
    "Success",
    "Term",
    "Uniform",
    "ends_of",
    "limits",
    "with_history",
]

__getattr__, _ = on_first_use(__name__, {"history": "with_history"})
