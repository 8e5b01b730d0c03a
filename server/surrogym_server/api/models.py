"""Routes of models: history, export, import, and predictions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal, TypeVar

from fastapi import APIRouter, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response

from surrogym_server.api import examples
from surrogym_server.api.door import ADMIN, READ, ConcurrencyLimit, DoorRoute, example
from surrogym_server.api.problems import documented
from surrogym_server.api.state import Use
from surrogym_server.convert import resources
from surrogym_server.convert.sessions import numbers
from surrogym_shared.codes import Code
from surrogym_shared.wire import Imagine, Imagined, ModelList, ModelView, Points, Prediction, Uncertainty

router = APIRouter(prefix="/v1/surrogates/{name}", tags=["models"], route_class=DoorRoute)

T = TypeVar("T")

SAFETENSORS = "application/octet-stream"
FILE: dict[str, Any] = {SAFETENSORS: {"schema": {"type": "string", "format": "binary"}}}
POINT_ERRORS = documented(
    Code.UNKNOWN_SURROGATE,
    Code.UNKNOWN_MODEL,
    Code.NO_MODEL,
    Code.NOT_INSTALLED,
    Code.INVALID_REQUEST,
    Code.TOO_LARGE,
    Code.TOO_MANY_REQUESTS,
)


@router.get(
    "/models",
    summary="List the versions of the model",
    dependencies=[READ],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
)
def list_all(name: str, use: Use) -> ModelList:
    """List all versions of a surrogate's model with their fidelity (how well they predict), oldest first."""
    return ModelList(models=[resources.model_view(record) for record in use.models.list(name)])


@router.get(
    "/models/{version}",
    summary="Describe or download a model",
    response_model=ModelView,
    dependencies=[READ],
    responses={
        200: {"content": {SAFETENSORS: {}}},
        **documented(Code.UNKNOWN_SURROGATE, Code.UNKNOWN_MODEL, Code.NO_MODEL, Code.INVALID_REQUEST),
    },
)
def get(name: str, version: int, use: Use, format: Literal["json", "safetensors"] = "json") -> ModelView | Response:
    """Return a model's structure and its fidelity (how well it predicts), or with ``format=safetensors`` the complete
    model as a file."""
    if format == "json":
        return resources.model_view(use.storage.models.get(name, version))
    return Response(use.models.export(name, version), media_type=SAFETENSORS)


@router.post(
    "/models",
    status_code=201,
    summary="Import a model",
    dependencies=[ADMIN],
    openapi_extra={"requestBody": {"required": True, "content": FILE}},
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST, Code.TOO_LARGE, Code.NOT_INSTALLED),
)
async def add(name: str, request: Request, use: Use) -> ModelView:
    """Import a model from an exported file. The model must have the same outputs as the surrogate. It becomes the
    surrogate's newest version."""
    data = await request.body()
    return resources.model_view(await run_in_threadpool(use.models.add, name, data))


@router.post(
    "/query_uncertainty",
    summary="Uncertainty of given points",
    dependencies=[READ],
    responses=POINT_ERRORS,
)
async def query_uncertainty(
    name: str, body: Annotated[Points, example(examples.POINTS)], request: Request, use: Use
) -> Uncertainty:
    """Return for each point and output: mean, standard deviation, model uncertainty (eq. 10), input probability (eq.
    11) and uncertainty index (eq. 12) of Active Uncertainty Reduction."""
    q, u = numbers("coordinates", body.coordinates), numbers("action", body.action)
    said = await _in_turn(request, lambda: use.models.query_uncertainty(name, q, u, body.model))
    return resources.uncertainty(said)


@router.post("/predict", summary="Predict one step without a session", dependencies=[READ], responses=POINT_ERRORS)
async def predict(
    name: str, body: Annotated[Points, example(examples.POINTS)], request: Request, use: Use
) -> Prediction:
    """Predict one step from each point (coordinates and action) by the model's mean. No session is needed."""
    q, u = numbers("coordinates", body.coordinates), numbers("action", body.action)
    return resources.prediction(await _in_turn(request, lambda: use.models.predict(name, q, u, body.model)))


@router.post("/imagine", summary="Simulate episodes from a given state", dependencies=[READ], responses=POINT_ERRORS)
async def imagine(
    name: str, body: Annotated[Imagine, example(examples.IMAGINE)], request: Request, use: Use
) -> Imagined:
    """Simulate episodes in the model, without a session. One episode follows the model's mean. ``draws`` further
    episodes follow functions sampled from the posterior, which diverge where the model is uncertain. An episode that
    terminates is shorter than ``actions``."""
    q, u = numbers("coordinates", body.coordinates), numbers("actions", body.actions)
    draws, seed, version = body.draws, body.seed, body.model
    episodes = await _in_turn(request, lambda: use.models.imagine(name, q, u, draws=draws, seed=seed, version=version))
    return resources.imagined(episodes)


async def _in_turn(request: Request, work: Callable[[], T]) -> T:
    """Wait until few enough predictions run at the same time, then run ``work`` in a thread. Without this limit,
    read-only callers would delay samplers and trainers."""
    turns: ConcurrencyLimit = request.app.state.turns
    return await turns.take(request, work)
