"""Which samplers are at work."""

from __future__ import annotations

from surrogym_server.services.activity import Samplers


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_sampler_that_falls_silent_is_gone():
    clock = Clock()
    samplers = Samplers(clock)
    samplers.heard("a", "one")
    clock.now += 40
    samplers.heard("a", "two")
    samplers.heard("b", "three")
    assert samplers.by_surrogate()["a"] == ["one", "two"]
    clock.now += 40
    assert samplers.by_surrogate()["a"] == ["two"]
