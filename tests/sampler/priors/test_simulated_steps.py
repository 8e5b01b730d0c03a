"""How many simulated steps the model of a simulator is learned from."""

from __future__ import annotations

import time

import pytest

import surrogym
from support.hinge import Real, Stiff, Textbook, hinge_spec, steps_of
from surrogym_sampler.priors import prior
from surrogym_sampler.priors.prior import Careful


@pytest.fixture(autouse=True)
def few(monkeypatch):
    monkeypatch.setattr(prior, "BY_INPUT", 5)
    monkeypatch.setattr(prior, "FEWEST", 10)
    monkeypatch.setattr(prior, "FURTHER", 60)
    monkeypatch.setattr(prior, "SLOW", 0.001)


class Slow(Stiff):
    def step_from(self, coordinates, action):
        time.sleep(0.002)
        return super().step_from(coordinates, action)


@pytest.mark.parametrize(("simulator", "given", "taken"), [(Stiff, None, 60), (Stiff, 20, 20), (Slow, None, 15)])
def test_a_simulators_model_that_is_not_certain_is_learned_from_more_steps_unless_they_are_slow(
    simulator, given, taken
):
    made = surrogym.Prior(simulator(), hinge_spec(), ["mass"], steps=given)
    assert made.update(steps_of(Real(), 6))
    assert made.file is not None
    assert len(made.file.samples) == taken
    assert made.file.about["simulated_steps"] == taken


def test_a_certain_model_of_a_simulator_is_learned_from_the_usual_number_of_steps(monkeypatch):
    monkeypatch.setattr(prior, "FEWEST", 80)
    made = surrogym.Prior(Textbook(), hinge_spec(), ["mass"])
    assert made.update(steps_of(Real(), 6))
    assert made.steps == 80
    assert surrogym.Prior(made.simulator, hinge_spec()).source == made.source == "Textbook"
    assert Careful(made.simulator).spec().coordinates == made.spec.coordinates
