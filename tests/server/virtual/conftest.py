"""Exact models, and lanes that have started."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from support.exact_models import ExactModel, exact_cartpole, exact_pendulum
from surrogym_server.virtual import LaneState, VirtualSettings, create, reset

Started = tuple[VirtualSettings, LaneState]


@pytest.fixture(scope="session")
def pendulum_model() -> ExactModel:
    return exact_pendulum()


@pytest.fixture(scope="session")
def cartpole_model() -> ExactModel:
    return exact_cartpole()


@pytest.fixture
def started() -> Callable[..., Started]:
    """Settings, and lanes reset once."""

    def start(model: ExactModel, num_envs: int, seed: int = 0, **chosen: Any) -> Started:
        settings = VirtualSettings(num_envs, **chosen)
        lanes, _ = reset(model.definition, settings, create(model.definition, settings, seed))
        return settings, lanes

    return start
