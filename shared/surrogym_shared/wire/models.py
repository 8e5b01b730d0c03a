"""Models: predictions and history."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from surrogym_shared.wire.base import Matrix, Reply, Request
from surrogym_shared.wire.surrogates import Fidelity


class Points(Request):
    coordinates: Matrix
    action: Matrix
    model: Annotated[int, Field(ge=1)] | None = Field(default=None, description="version; None is the latest")


class Uncertainty(Reply):
    """Per point and output: posterior mean of the output, latent deviation, U_m (eq. 10), P_i (eq. 11), U (eq. 12)."""

    model_version: int
    outputs: list[str]
    mean: list[list[float]]
    deviation: list[list[float]]
    model_uncertainty: list[list[float]]
    input_probability: list[list[float]]
    log_uncertainty_index: list[list[float]]
    uncertainty_index: list[list[float]]


class Prediction(Reply):
    model_version: int
    next_coordinates: list[list[float]]
    next_observation: list[list[float]]
    reward: list[float] = Field(description="posterior mean, without the penalty")
    reward_deviation: list[float]
    terminated: list[bool]


class ModelView(Reply):
    version: int
    created_at: float
    samples: int
    data_hash: str
    fidelity: Fidelity
    fit_seconds: float
    description: dict[str, Any] = Field(description="structure and hyperparameters of every output")


class ModelList(Reply):
    models: list[ModelView]
