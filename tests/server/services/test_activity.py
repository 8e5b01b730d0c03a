"""Which samplers are at work."""

from __future__ import annotations

from surrogym_server.services.activity import ALIVE_SECONDS, MOST_NAMES, Samplers


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_sampler_that_sends_nothing_for_a_while_is_no_longer_listed():
    clock = Clock()
    samplers = Samplers(clock)
    samplers.heard("a", "one")
    clock.now += 40
    samplers.heard("a", "two")
    samplers.heard("b", "three")
    assert samplers.by_surrogate()["a"] == ["one", "two"]
    clock.now += 40
    assert samplers.by_surrogate()["a"] == ["two"]


def test_the_number_of_listed_sampler_names_is_limited():
    clock = Clock()
    samplers = Samplers(clock)
    samplers.heard("a", "honest")
    for i in range(3 * MOST_NAMES):
        samplers.heard("a", f"made up {i}")
    samplers.heard("b", "other")
    heard = samplers.by_surrogate()
    assert len(heard["a"]) == MOST_NAMES
    assert "honest" in heard["a"]
    assert heard["b"] == ["other"]
    clock.now += ALIVE_SECONDS
    samplers.heard("a", "late")
    assert samplers.by_surrogate() == {"a": ["late"]}
