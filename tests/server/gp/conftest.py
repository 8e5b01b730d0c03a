"""Processes to compare: points, and hyperparameters of every kernel."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from surrogym_server.gp import Hyperparameters


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture(params=["squared exponential", "linear", "quadratic", "both"])
def hyper(request: pytest.FixtureRequest) -> Hyperparameters:
    """Three inputs, noise 1e-4."""
    linear = 0.7 if request.param in ("linear", "both") else 0.0
    quadratic = 0.3 if request.param in ("quadratic", "both") else 0.0
    return Hyperparameters(torch.tensor([0.8, 1.7, 3.1], dtype=torch.float64), 1.6, linear, quadratic, 1e-4)
