"""The ASGI app of the server: the only module that builds the storage, the engine and the services."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, TypedDict
from uuid import uuid4

import torch
from fastapi import FastAPI
from fastapi.responses import Response
from threadpoolctl import threadpool_limits

from surrogym_server import dashboard
from surrogym_server.api import (
    events,
    logs,
    metrics,
    models,
    openapi,
    problems,
    queries,
    samples,
    service,
    sessions,
    surrogates,
)
from surrogym_server.api.door import ConcurrencyLimit, Gate, Waiting, fingerprint
from surrogym_server.api.middleware import BodyLimit, KnownHosts, Observed, OwnPages
from surrogym_server.api.state import Services
from surrogym_server.api.stepping.routes import StepDoor
from surrogym_server.api.stepping.routes import router as stepping
from surrogym_server.convert import definition_from_spec, stored_definition
from surrogym_server.convert.stored import read_stored
from surrogym_server.engine.design_job import DesignJob, DesignResult, run_design_job
from surrogym_server.engine.fits import Fits
from surrogym_server.engine.local import MEBIBYTE, Limits, LocalEngine
from surrogym_server.engine.models import ModelCache
from surrogym_server.engine.port import Compute, SessionEngine
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput
from surrogym_server.feature import Cluster, Core, Feature, Parts
from surrogym_server.features.jobs import FEATURE as jobs
from surrogym_server.features.policies import FEATURE as policies
from surrogym_server.features.priors import FEATURE as priors
from surrogym_server.features.ray.pool import CLUSTER as ray
from surrogym_server.features.watching import FEATURE as watching
from surrogym_server.file_permissions import keep_private
from surrogym_server.models.registry import MODELS
from surrogym_server.sampling.acquisition import ACQUISITIONS
from surrogym_server.sampling.design import initial_queries
from surrogym_server.services.activity import Samplers
from surrogym_server.services.definitions import Definitions
from surrogym_server.services.designer import Designer, DesignerSettings
from surrogym_server.services.events import EventService
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_server.services.models import ModelService, load_model, stored_tolerances
from surrogym_server.services.notices import Notices
from surrogym_server.services.queries import QueryService
from surrogym_server.services.samples import SampleService
from surrogym_server.services.sessions import SessionService
from surrogym_server.services.surrogates import Plan, SurrogateService
from surrogym_server.services.sweeper import Sweeper
from surrogym_server.settings import LOCAL_NAMES, Settings
from surrogym_server.storage.sql import Storage, open_storage
from surrogym_shared.spec import EnvironmentSpec

# Optional features of the server. To remove one, delete its folder in ``features`` and its line here.
FEATURES: tuple[Feature, ...] = (
    policies,
    jobs,
    priors,
    watching,
)
# Clusters of machines that can run sessions and fits, by the value of the setting ``engine`` that chooses each.
CLUSTERS: dict[str, Cluster] = {
    "ray": ray,
}

logger = logging.getLogger(__name__)

DESCRIPTION = """Learns a virtual environment from a handful of real steps and serves it to any trainer.

A sampler claims queries and adds samples; a trainer opens a session and steps it; the server chooses the queries.
"""


@dataclass(frozen=True)
class DesignPort:
    """The two functions of the design of queries: ``plan`` chooses the first queries, and ``run`` computes a round: it
    fits a model and chooses the next queries. Tests replace both by faster functions."""

    plan: Plan = initial_queries
    run: Callable[[DesignJob], DesignResult] = run_design_job


class State(TypedDict):
    """Objects that each request can read from ``request.state``: the services, and those of the optional features."""

    services: Services
    parts: Parts


@dataclass(frozen=True)
class _Process:
    """Objects that a server process has once, and that its services share."""

    storage: Storage
    definitions: Definitions
    models: ModelCache
    engine: SessionEngine
    fits: Compute
    notices: Notices
    metrics: ProcessMetrics


def create_app(settings: Settings, design: DesignPort = DesignPort(), fits: Fits | None = None) -> FastAPI:
    """Create the server as an ASGI app. The app opens its database here and closes it at the end of its lifespan.

    Args:
        settings: the server's settings.
        design: functions that choose the first queries and compute a round.
        fits: child processes that compute rounds, if they have been created already; None to create them. The app
            closes them.

    Raises:
        InvalidInput: the address of the database can't be used, the device does not exist, or the cluster does not
            exist or is not the expected one.
        Unavailable: another server uses the database, or the database or the cluster's session hosts don't answer.
    """
    _check_device(settings.device)
    cluster = _cluster(settings.engine)
    if cluster is not None:
        cluster.check(settings)
    keep_private(settings)
    storage = open_storage(settings.database_url)
    engine = None if cluster is None else _connected(cluster, settings, storage)
    app = FastAPI(
        title="Surrogym",
        version=version("surrogym"),
        description=DESCRIPTION,
        lifespan=lambda app: _lifespan(app, settings, storage, design, engine, fits),
        docs_url=None,
        redoc_url=None,
        openapi_url=None,
        # FastAPI's hooks for telemetry are switched off: the app has metrics of its own, and each request takes 5 us
        # less.
        telemetry={"tracing": False, "metrics": False, "logs": False},
    )
    app.state.gate = Gate(settings.tokens)
    app.state.max_body_bytes = settings.max_body_bytes
    app.state.parsing = asyncio.Lock()
    app.state.turns = ConcurrencyLimit("predictions", at_work=2, waiting=32)
    app.state.streams = Waiting("open streams of events")
    app.state.query_claims = Waiting("waiting claims of queries")
    app.state.log_turns = ConcurrencyLimit("logs", at_work=1, waiting=8)
    if settings.tokens:
        known = ", ".join(f"{role} {fingerprint(token)}" for token, role in settings.tokens.items())
        logger.info("fingerprints of the tokens: %s", known)
    app.state.notices = None
    app.state.metrics = ProcessMetrics()
    problems.install(app)
    openapi.install(app)
    app.add_middleware(StepDoor)
    app.add_middleware(BodyLimit, max_together=settings.max_bodies_bytes)
    app.add_middleware(OwnPages, public_url=settings.public_url)
    if settings.loopback and not settings.tokens:
        app.add_middleware(KnownHosts, hosts=frozenset({*LOCAL_NAMES, "127.0.0.1", "::1", *settings.host_names}))
    app.add_middleware(Observed, metrics=app.state.metrics)
    # Most requests are steps, so their routes are searched first. They are added directly, because an included router
    # would need a search of its own.
    app.router.routes.extend(stepping.routes)
    rooms = (sessions, service, metrics, surrogates, queries, samples, logs, models)
    for one in (*(room.router for room in rooms), *(feature.router for feature in FEATURES), events.router):
        app.include_router(one)
    _add_dashboard(app)
    return app


def _check_device(name: str) -> None:
    if name == "cuda" and not torch.cuda.is_available():
        why = "this torch build has no CUDA" if torch.version.cuda is None else "torch finds no GPU that it can use"
        raise InvalidInput(f"setting device: expected cpu, got cuda, which can't be used, because {why}: set it to cpu")


def _cluster(engine: str) -> Cluster | None:
    if engine not in ("local", *CLUSTERS):
        raise InvalidInput(
            f"setting engine: expected {' or '.join(('local', *CLUSTERS))}, got {engine}: choose one of these"
        )
    return CLUSTERS.get(engine)


def _connected(cluster: Cluster, settings: Settings, storage: Storage) -> SessionEngine:
    try:
        return cluster.connect(settings, storage)
    except BaseException:
        storage.close()
        raise


def say_goodbye(app: FastAPI) -> None:
    """End all requests that wait for work or events (long polls and streams), so that a shutdown need not wait."""
    if app.state.notices is not None:
        app.state.notices.close()


@asynccontextmanager
async def _lifespan(
    app: FastAPI,
    settings: Settings,
    storage: Storage,
    design: DesignPort,
    engine: SessionEngine | None,
    fits: Fits | None,
) -> AsyncIterator[State]:
    torch.set_num_threads(settings.threads)
    # Limits the threads of NumPy's matrix products, by which policies compute their actions.
    threadpool_limits(settings.threads, user_api="blas")
    process = _build_process(settings, design, storage, app.state.metrics, engine, fits)
    app.state.notices = process.notices
    services = _build_services(settings, design, process)
    core = Core(settings, storage, process.notices, process.metrics, _complete)
    parts = {type(one): one for one in [feature.start(core) for feature in FEATURES]}
    sweeps = [one.sweep for one in parts.values()]
    sweeper = Sweeper(storage, process.engine, settings.sweep_seconds, process.metrics, process.notices, sweeps)
    for registry in (ACQUISITIONS, MODELS):
        logger.info("%ss: %s", registry.kind, ", ".join(registry.names))
        for name, why in registry.broken.items():
            logger.warning("the %s %r is left out: %s", registry.kind, name, why)
    process.fits.start()
    restored = await services.sessions.restore()
    if restored:
        logger.info("sessions restored: %d", restored)
    looking = asyncio.to_thread(_name_lacking, process.definitions)
    work = (services.designer.run(), sweeper.run(), looking, process.engine.start())
    tasks = [asyncio.create_task(one) for one in work]
    try:
        yield {"services": services, "parts": parts}
    finally:
        process.notices.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await process.engine.stop()
        await asyncio.to_thread(process.fits.close)
        if not process.engine.lasting:
            logger.info("sessions saved: %d", await services.sessions.save())
        storage.close()


def _build_process(
    settings: Settings,
    design: DesignPort,
    storage: Storage,
    metrics: ProcessMetrics,
    engine: SessionEngine | None,
    fits: Fits | None,
) -> _Process:
    definitions = Definitions(storage, _stored_definition)
    models = ModelCache(
        load=lambda surrogate, version: load_model(storage, definitions, surrogate, version),
        newest=storage.models.newest,
    )
    engine = engine or LocalEngine(
        models,
        lambda surrogate, version: stored_tolerances(storage, surrogate, version),
        limits=Limits(settings.max_sessions, settings.max_sessions_mib * MEBIBYTE, settings.max_waiting),
        max_lanes=settings.max_lanes,
        idle_seconds=settings.session_idle_seconds,
        device=torch.device(settings.device),
    )
    cluster = _cluster(settings.engine)
    compute = cluster and cluster.fits(settings, design.run)
    compute = compute or fits or Fits(design.run, settings.fit_workers)
    return _Process(storage, definitions, models, engine, compute, Notices(storage.announcements), metrics)


def _build_services(settings: Settings, design: DesignPort, process: _Process) -> Services:
    storage, definitions, notices, samplers = process.storage, process.definitions, process.notices, Samplers()
    designer = Designer(
        storage,
        definitions,
        design.plan,
        process.fits,
        process.models,
        notices,
        process.metrics,
        DesignerSettings(
            owner=uuid4().hex,
            threads=settings.threads,
            look_seconds=settings.sweep_seconds,
            fit_seconds=settings.fit_seconds,
            fit_workers=settings.fit_workers,
        ),
    )
    return Services(
        surrogates=SurrogateService(
            storage, definitions, _define, _complete, design.plan, process.engine, notices, samplers
        ),
        queries=QueryService(storage, definitions, notices, samplers),
        samples=SampleService(storage, definitions, notices, samplers),
        models=ModelService(storage, definitions, process.models, notices),
        sessions=SessionService(storage, definitions, process.engine),
        engine=process.engine,
        designer=designer,
        events=EventService(storage, notices),
        storage=storage,
    )


def _name_lacking(definitions: Definitions) -> None:
    for sentence in definitions.lacking():
        logger.warning("%s; it can still be read, but fits and sessions are refused", sentence)


def _define(spec: dict[str, Any]) -> EnvironmentDefinition:
    """Convert the specification of a new surrogate (JSON that is validated already) to an environment definition."""
    return definition_from_spec(EnvironmentSpec.model_validate(spec))


def _stored_definition(spec: dict[str, Any]) -> EnvironmentDefinition:
    return stored_definition(read_stored(EnvironmentSpec, "a stored specification", spec))


def _complete(spec: dict[str, Any]) -> dict[str, Any]:
    return EnvironmentSpec.model_validate(spec).model_dump(mode="json")


def _add_dashboard(app: FastAPI) -> None:
    for path, (name, media_type) in dashboard.FILES.items():
        app.add_api_route(path, _static(name, media_type), methods=["GET", "HEAD"], include_in_schema=False)


def _static(name: str, media_type: str) -> Callable[[], Awaitable[Response]]:
    async def page() -> Response:
        return Response(dashboard.read(name), media_type=media_type, headers=dashboard.HEADERS)

    return page
