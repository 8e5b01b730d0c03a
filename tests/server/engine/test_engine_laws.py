"""The engine of this process keeps the laws of the port."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

from surrogym_server.engine.local import LocalEngine
from surrogym_server.engine.models import ModelCache
from surrogym_server.engine.sessions import Limits
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import UnknownModel
from surrogym_server.models.port import DynamicsModel
from surrogym_server.testing import LAWS_OF_ENGINES, EngineCase

SURROGATE = 5


@pytest.mark.parametrize("law", LAWS_OF_ENGINES, ids=lambda law: law.__name__)
def test_the_engine_of_this_process_keeps_the_laws(
    law, definition: EnvironmentDefinition, fitted: Callable[[int], DynamicsModel]
):
    def load(surrogate: int, version: int) -> DynamicsModel:
        if version != 1:
            raise UnknownModel(f"no model {version}")
        return fitted(12)

    async def kept() -> None:
        models = ModelCache(load, lambda: {SURROGATE: 1})
        tolerances = (0.1,) * len(definition.outputs)
        engine = LocalEngine(models, lambda *_: tolerances, limits=Limits(), max_lanes=64, idle_seconds=60)
        await engine.start()
        try:
            await law(EngineCase(engine, "pendulum", SURROGATE, definition))
        finally:
            await engine.stop()

    asyncio.run(kept())
