"""Wire models of the fitted models of a surrogate: predictions, virtual episodes and versions."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from surrogym_shared.wire.base import MAX_DRAWS, MAX_IMAGINED, Matrix, Reply, Request, Seed, Vector
from surrogym_shared.wire.surrogates import Fidelity


class Points(Request):
    """States and actions at which the model is evaluated."""

    coordinates: Matrix = Field(description="(n, C) states: n points of C coordinates")
    action: Matrix = Field(description="(n, F) action of F entries at each of the n points")
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
    deviation: list[list[float]] = Field(description="(n, O) posterior standard deviation, without the noise of a step")
    model_uncertainty: list[list[float]] = Field(
        description="(n, O) model uncertainty, U_m of eq. 10 of Active Uncertainty Reduction"
    )
    input_probability: list[list[float]] = Field(description="(n, O) input probability, P_i of eq. 11")
    log_uncertainty_index: list[list[float]] = Field(description="(n, O) natural logarithm of the uncertainty index")
    uncertainty_index: list[list[float]] = Field(description="(n, O) uncertainty index, U of eq. 12")


class Prediction(Reply):
    """Predictions of one step from each of n points."""

    model_version: int = Field(description="version of the model")
    next_coordinates: list[list[float]] = Field(description="(n, C) predicted mean of the next state")
    next_observation: list[list[float]] = Field(
        description="(n, D) observation of D entries at the predicted next state"
    )
    reward: list[float] = Field(description="(n,) predicted mean of the reward, without a penalty for uncertainty")
    reward_deviation: list[float] = Field(description="(n,) predicted standard deviation of the reward")
    terminated: list[bool] = Field(description="(n,) whether the step ends the episode")


class Imagine(Request):
    """Request for virtual episodes under given actions: one with the model's mean prediction in each step, and some
    with functions that are sampled from the model's posterior."""

    coordinates: Vector = Field(description="(C,) state at the start")
    actions: Annotated[list[Vector], Field(min_length=1, max_length=MAX_IMAGINED)] = Field(
        description="(T, F) actions of F entries to apply in T steps"
    )
    draws: Annotated[int, Field(ge=0, le=MAX_DRAWS)] = Field(
        default=0, description="number of episodes that each follow a function sampled from the posterior"
    )
    seed: Seed = Field(default=0, description="seed of the sampled functions")
    model: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="version of the model; null: the latest"
    )


class ImaginedEpisode(Reply):
    """A virtual episode of t steps. t is less than T, the number of actions, if the episode terminated before."""

    coordinates: list[list[float]] = Field(description="(t + 1, C) states, beginning with the start")
    reward: list[float] = Field(description="(t,) reward of each step")
    terminated: bool = Field(description="whether the episode ended in a terminal state")


class Imagined(Reply):
    """Reply with virtual episodes under the requested actions."""

    model_version: int = Field(description="version of the model")
    mean: ImaginedEpisode = Field(description="episode that moves by the model's mean prediction")
    draws: list[ImaginedEpisode] = Field(description="one episode for each sampled function, which it follows")


class ModelView(Reply):
    """One version of a surrogate's model: its samples, its fidelity and its structure."""

    version: int = Field(description="version number; a later model has a higher one")
    created_at: float = Field(description="when the model was stored, in seconds since 1970, by the server's clock")
    samples: int = Field(description="number of samples that the model was fitted to")
    data_hash: str = Field(description="hash of the samples that the model was fitted to")
    fidelity: Fidelity = Field(description="how well the model predicts")
    fit_seconds: float = Field(description="duration of the fit; 0 for an imported model")
    description: dict[str, Any] = Field(description="structure and hyperparameters of every output")


class ModelList(Reply):
    """All versions of a surrogate's model."""

    models: list[ModelView] = Field(description="all versions of the model, oldest first")
