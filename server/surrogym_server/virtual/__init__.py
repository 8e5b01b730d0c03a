"""Virtual environments that a model simulates: N lanes (parallel environments) step at once. A step is a pure function
of the model, the lanes' state and the actions."""

from surrogym_server.virtual.environment import (
    LaneTransition,
    VirtualSettings,
    create,
    expected_bytes,
    expected_gpu_bytes,
    reset,
)
from surrogym_server.virtual.lanes import LaneState
from surrogym_server.virtual.limits import reward_limits, within
from surrogym_server.virtual.residual import Residual
from surrogym_server.virtual.step import in_fastest_form, step

__all__ = [
    "LaneState",
    "LaneTransition",
    "Residual",
    "VirtualSettings",
    "create",
    "expected_bytes",
    "expected_gpu_bytes",
    "in_fastest_form",
    "reset",
    "reward_limits",
    "step",
    "within",
]
