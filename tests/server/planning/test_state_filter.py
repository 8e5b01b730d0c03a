"""The state filter equals a Kalman filter on a linear system, and starts anew where a measurement contradicts it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.errors import InvalidInput
from surrogym_server.models.abilities import ArrayTransition
from surrogym_server.planning.state_filter import StateFilter
from surrogym_shared.spec import Coordinate, Uniform

MOTION = np.array([[1.0, 0.1], [-0.2, 0.9]])
PUSH = np.array([0.02, 0.3])
STD = 0.05  # of the model's prediction of the second coordinate


def linear():
    """The definition of a system of two linear coordinates, with the observation of a pendulum."""
    spec = pendulum()
    own = tuple(Coordinate(name=c.name, sampling=Uniform(low=-5, high=5)) for c in spec.coordinates)
    return definition_from_spec(spec.model_copy(update={"coordinates": own}))


class Linear:
    """Steps of a linear system, whose model is not certain about the second coordinate."""

    definition = linear()

    def __call__(self, q, u, **options):
        std = np.tile([0.0, STD, 0.0], (len(q), 1))
        return ArrayTransition(q @ MOTION.T + u * PUSH, np.zeros(len(q)), std, np.zeros(len(q), dtype=bool))


class Model:
    """A model with a definition and no learned noise."""

    definition = Linear.definition


def made(noise: tuple[float, float]) -> StateFilter:
    names = Linear.definition.coordinate_names
    return StateFilter.of(Model(), Linear(), dict(zip(names, noise, strict=True)))  # type: ignore[arg-type]


def test_states_and_covariances_are_those_of_a_kalman_filter():
    noise, rng = (0.3, 0.2), np.random.default_rng(0)
    found, r, process = made(noise), np.diag(np.square(noise)), np.diag([0.0, STD**2])
    true, u = np.array([1.0, -0.5]), np.array([0.7])
    measured = true + rng.normal(size=2) * noise
    state, covariance = measured[None].copy(), found.measured[None]
    expected, p = measured, r
    for _ in range(30):
        covariance = found.predicted(state, covariance, u[None])
        predicted = Linear()(state, u[None]).q_next
        expected, p = MOTION @ expected + u * PUSH, MOTION @ p @ MOTION.T + process
        true = MOTION @ true + u * PUSH
        measured = true + rng.normal(size=2) * noise
        state, covariance = found.corrected(measured[None], predicted, covariance)
        gain = p @ np.linalg.inv(p + r)
        expected, p = expected + gain @ (measured - expected), (np.eye(2) - gain) @ p
        np.testing.assert_allclose(state[0], expected, atol=1e-4)
        np.testing.assert_allclose(covariance[0] * np.outer(found.span, found.span), p, atol=1e-4)


def test_an_exact_sensor_is_believed_and_a_measurement_that_contradicts_the_prediction_begins_anew():
    found = made((0.3, 0.0))
    predicted, covariance = np.array([[1.0, 2.0], [1.0, 2.0]]), np.tile(1e-4 * np.eye(2), (2, 1, 1))
    state, after = found.corrected(np.array([[1.2, 2.05], [4.0, 2.0]]), predicted, covariance)
    assert state[0, 1] == pytest.approx(2.05, abs=1e-4)
    assert 1.0 < state[0, 0] < 1.2
    assert state[1].tolist() == [4.0, 2.0]
    assert after[1].tolist() == found.measured.tolist()


def test_noise_of_an_unknown_coordinate_is_refused():
    with pytest.raises(InvalidInput, match="expected names of coordinates that change in steps, got 'heat'"):
        StateFilter.of(Model(), Linear(), {"heat": 0.1})  # type: ignore[arg-type]


def test_a_model_of_the_observation_is_refused():
    class OfObservation:
        definition = SimpleNamespace(moves_observation=True)

    with pytest.raises(InvalidInput, match=r"expected a model that predicts changes of coordinates, got .*'paper'"):
        StateFilter.of(OfObservation(), Linear(), {})  # type: ignore[arg-type]
