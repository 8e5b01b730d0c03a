"""The engine of this process keeps the laws of the port."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable

import pytest

from support.engine_laws import LAWS_OF_ENGINES, EngineCase
from surrogym_server.engine.local import Limits, LocalEngine
from surrogym_server.engine.models import ModelCache
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import UnknownModel
from surrogym_server.models.port import DynamicsModel

SURROGATE = 5


@pytest.mark.parametrize("law", LAWS_OF_ENGINES, ids=lambda law: law.__name__)
def test_the_local_session_engine_passes_the_engine_interface_tests(
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


def test_opening_a_session_does_not_wait_for_another_surrogates_model_to_load(
    definition: EnvironmentDefinition, fitted: Callable[[int], DynamicsModel]
):
    """The model of a long log takes long to load."""
    loading, loaded, large = threading.Event(), threading.Event(), SURROGATE + 1

    def load(surrogate: int, version: int) -> DynamicsModel:
        del version
        if surrogate == large:
            loading.set()
            assert loaded.wait(60)
        return fitted(12)

    async def opens() -> None:
        models = ModelCache(load, lambda: {SURROGATE: 1, large: 1})
        engine = LocalEngine(models, lambda *_: (), limits=Limits(), max_lanes=64, idle_seconds=60)
        try:
            slow = asyncio.create_task(engine.open(EngineCase(engine, "log", large, definition).asked()))
            await asyncio.to_thread(loading.wait, 60)
            await asyncio.wait_for(engine.open(EngineCase(engine, "pendulum", SURROGATE, definition).asked()), 30)
            assert not slow.done()
            loaded.set()
            await slow
        finally:
            loaded.set()
            await engine.stop()

    asyncio.run(opens())
