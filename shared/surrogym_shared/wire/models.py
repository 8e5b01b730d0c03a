"""Wire models of models: predictions and history."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from surrogym_shared.wire.base import MAX_DRAWS, MAX_IMAGINED, Matrix, Reply, Request, Seed, Vector
from surrogym_shared.wire.surrogates import Fidelity


class Points(Request):
    coordinates: Matrix
    action: Matrix
    model: Annotated[int, Field(ge=1)] | None = Field(default=None, description="version; None is the latest")


class Uncertainty(Reply):
    """For each point and output: posterior mean, standard deviation without noise, U_m (eq. 10), P_i (eq. 11), U
    (eq. 12)."""

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


class Imagine(Request):
    """Episodes from ``coordinates`` with ``actions``: along the mean, and along ``draws`` functions from the
    posterior."""

    coordinates: Vector
    actions: Annotated[list[Vector], Field(min_length=1, max_length=MAX_IMAGINED)] = Field(description="(T, F)")
    draws: Annotated[int, Field(ge=0, le=MAX_DRAWS)] = 0
    seed: Seed = 0
    model: Annotated[int, Field(ge=1)] | None = Field(default=None, description="version; None is the latest")


class ImaginedEpisode(Reply):
    coordinates: list[list[float]] = Field(description="(t + 1, C), the start included; t is below T where it ended")
    reward: list[float] = Field(description="(t,)")
    terminated: bool


class Imagined(Reply):
    model_version: int
    mean: ImaginedEpisode
    draws: list[ImaginedEpisode]


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
