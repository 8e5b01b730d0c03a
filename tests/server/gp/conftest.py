"""Processes to compare: points, and hyperparameters of every kernel."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from surrogym_server.gp import Hyperparameters, Reflection


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


SIGNS = (-1.0, 1.0, -1.0)
PLAIN = ["squared exponential", "linear", "quadratic", "both"]


@pytest.fixture(params=PLAIN)
def plain(request: pytest.FixtureRequest) -> Hyperparameters:
    """Three inputs, noise 1e-4."""
    return hyperparameters(request.param)


@pytest.fixture(params=[*PLAIN, "odd", "even"])
def hyper(request: pytest.FixtureRequest) -> Hyperparameters:
    """The same; odd and even have every part, and a reflection that turns the first input and the last."""
    if request.param in PLAIN:
        return hyperparameters(request.param)
    parity = 1 if request.param == "even" else -1
    return hyperparameters("both", Reflection(torch.tensor(SIGNS, dtype=torch.float64), parity))


def hyperparameters(kernel: str, reflection: Reflection | None = None) -> Hyperparameters:
    linear = 0.7 if kernel in ("linear", "both") else 0.0
    quadratic = 0.3 if kernel in ("quadratic", "both") else 0.0
    lengthscale = torch.tensor([0.8, 1.7, 3.1], dtype=torch.float64)
    return Hyperparameters(lengthscale, 1.6, linear, quadratic, 1e-4, reflection)
