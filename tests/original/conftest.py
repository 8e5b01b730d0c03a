"""Environments that are registered with Gymnasium for one test."""

from __future__ import annotations

from collections.abc import Iterator

import gymnasium
import pytest

from support.simulators import Register, Spiral


@pytest.fixture
def registered() -> Iterator[Register]:
    """Registers a ``Spiral``, its class attributes replaced by those of ``space``."""
    names: list[str] = []

    def register(name: str, space: dict[str, object] | None = None, **options: object) -> str:
        made = type("Made", (Spiral,), space or {})
        gymnasium.register(name, entry_point=lambda: made(**options), max_episode_steps=30)
        names.append(name)
        return name

    yield register
    for name in names:
        gymnasium.registry.pop(name)
