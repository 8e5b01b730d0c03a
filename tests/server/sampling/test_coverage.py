"""Which initial queries a log makes unnecessary."""

from __future__ import annotations

import numpy as np
import pytest

from support import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.sampling.coverage import covered
from surrogym_server.sampling.design import initial_queries
from surrogym_shared.spec import EnvironmentSpec

QUERIES = 20


@pytest.fixture
def definition() -> EnvironmentDefinition:
    return definition_from_spec(EnvironmentSpec.model_validate(pendulum.spec(initial=QUERIES, budget=40)))


@pytest.fixture
def asked(definition: EnvironmentDefinition) -> tuple[np.ndarray, np.ndarray]:
    queries = initial_queries(definition, 40)
    return np.array([query.coordinates for query in queries]), np.array([query.action for query in queries])


def drawn(definition: EnvironmentDefinition, count: int, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Steps from the first ``share`` of each coordinate's range."""
    rng = np.random.default_rng(0)
    low = np.array([c.sampling.low for c in definition.coordinates])
    high = np.array([c.sampling.high for c in definition.coordinates])
    least, most = definition.action_limits
    q = low + share * (high - low) * rng.random((count, len(low)))
    return q, least + (most - least) * rng.random((count, len(least)))


def test_a_log_over_the_whole_range_replaces_all_initial_queries(definition: EnvironmentDefinition, asked):
    assert covered(definition, *asked, *drawn(definition, 3_000, share=1.0)).all()


def test_a_log_of_a_part_of_the_range_replaces_only_initial_queries_there(definition: EnvironmentDefinition, asked):
    found = covered(definition, *asked, *drawn(definition, 3_000, share=0.2))
    assert 0 < found.sum() < QUERIES / 2


def test_a_logged_angle_near_minus_pi_replaces_initial_queries_near_pi(definition: EnvironmentDefinition):
    q, u = np.array([[3.1, 0.0], [0.0, 0.0]]), np.zeros((2, 1))
    assert covered(definition, q, u, np.array([[-3.1, 0.0]]), np.zeros((1, 1))).tolist() == [True, False]


def test_an_empty_log_replaces_no_initial_query(definition: EnvironmentDefinition, asked):
    assert not covered(definition, *asked, np.zeros((0, 2)), np.zeros((0, 1))).any()
