"""The services of the app, as a dependency of its routes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Request

from surrogym_server.engine.port import SessionEngine
from surrogym_server.services.designer import Designer
from surrogym_server.services.events import EventService
from surrogym_server.services.models import ModelService
from surrogym_server.services.queries import QueryService
from surrogym_server.services.samples import SampleService
from surrogym_server.services.sessions import SessionService
from surrogym_server.services.surrogates import SurrogateService
from surrogym_server.storage.sql import Storage


@dataclass(frozen=True)
class Services:
    """The services that routes may call; ``app.py`` builds them."""

    surrogates: SurrogateService
    queries: QueryService
    samples: SampleService
    models: ModelService
    sessions: SessionService
    engine: SessionEngine
    designer: Designer
    events: EventService
    storage: Storage


async def _services(request: Request) -> Services:
    services = request.state.services
    assert isinstance(services, Services)
    return services


Use = Annotated[Services, Depends(_services)]
