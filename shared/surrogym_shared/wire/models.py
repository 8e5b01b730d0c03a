"""Messages about the fitted models of a surrogate: predictions and history."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from surrogym_shared.wire.base import MAX_DRAWS, MAX_IMAGINED, Matrix, Reply, Request, Seed, Vector
from surrogym_shared.wire.surrogates import Fidelity


class Points(Request):
    """States and actions at which the model is evaluated."""

    coordinates: Matrix = Field(description="(n, C) states")
    action: Matrix = Field(description="(n, F) actions")
    model: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="version of the model; null: the latest"
    )


class Uncertainty(Reply):
    """Predictions and their uncertainty, for each of n points and O outputs."""

    model_version: int = Field(description="version of the model")
    outputs: list[str] = Field(description="names of the outputs")
    mean: list[list[float]] = Field(
        description="(n, O) posterior mean: the change of each moving coordinate, and the reward"
    )
    deviation: list[list[float]] = Field(description="(n, O) standard deviation, without the noise of a step")
    model_uncertainty: list[list[float]] = Field(description="(n, O) U_m of eq. 10")
    input_probability: list[list[float]] = Field(description="(n, O) P_i of eq. 11")
    log_uncertainty_index: list[list[float]] = Field(description="(n, O) logarithm of U")
    uncertainty_index: list[list[float]] = Field(description="(n, O) U of eq. 12")


class Prediction(Reply):
    """Predictions of one step from each of n points."""

    model_version: int = Field(description="version of the model")
    next_coordinates: list[list[float]] = Field(description="(n, C) mean of the next state")
    next_observation: list[list[float]] = Field(description="(n, D) observation at that state")
    reward: list[float] = Field(description="(n,) mean of the reward, without a penalty")
    reward_deviation: list[float] = Field(description="(n,) standard deviation of the reward")
    terminated: list[bool] = Field(description="(n,) whether the step ends the episode")


class Imagine(Request):
    """Request for virtual episodes under given actions: one with the model's mean prediction in each step, and some
    with functions that are sampled from the model's posterior."""

    coordinates: Vector = Field(description="(C,) state at the start")
    actions: Annotated[list[Vector], Field(min_length=1, max_length=MAX_IMAGINED)] = Field(description="(T, F) actions")
    draws: Annotated[int, Field(ge=0, le=MAX_DRAWS)] = Field(default=0, description="number of functions to sample")
    seed: Seed = Field(default=0, description="seed of the sampled functions")
    model: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="version of the model; null: the latest"
    )


class ImaginedEpisode(Reply):
    """A virtual episode of t steps. t is less than T, the number of actions, if the episode terminated before."""

    coordinates: list[list[float]] = Field(description="(t + 1, C) states, the start included")
    reward: list[float] = Field(description="(t,) rewards")
    terminated: bool = Field(description="whether the episode terminated")


class Imagined(Reply):
    """Reply with virtual episodes under the requested actions."""

    model_version: int = Field(description="version of the model")
    mean: ImaginedEpisode = Field(description="episode along the mean")
    draws: list[ImaginedEpisode] = Field(description="episode along each drawn function")


class ModelView(Reply):
    """A version of a surrogate's model."""

    version: int = Field(description="version number; a later model has a higher one")
    created_at: float = Field(description="when it was stored, in seconds since 1970, by the server's clock")
    samples: int = Field(description="number of samples that it was fitted to")
    data_hash: str = Field(description="hash of these samples")
    fidelity: Fidelity = Field(description="how well the model predicts")
    fit_seconds: float = Field(description="duration of the fit; 0 for an imported model")
    description: dict[str, Any] = Field(description="structure and hyperparameters of every output")


class ModelList(Reply):
    """All versions of a surrogate's model."""

    models: list[ModelView] = Field(description="versions, oldest first")
