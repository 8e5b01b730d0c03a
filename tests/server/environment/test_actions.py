"""The door for actions: what a policy may send, what the model gets, and every refusal."""

from dataclasses import replace

import numpy as np
import pytest

from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.actions import model_actions, policy_actions
from surrogym_server.errors import InvalidInput
from surrogym_shared.spec import BoxAction, DiscreteAction, MultiDiscreteAction

PENDULUM = definition_from_spec(pendulum())
BOX = replace(PENDULUM, action=BoxAction(low=(-2.0, 0.0), high=(2.0, 1.0)))
BINS = replace(PENDULUM, action=BoxAction(low=(-2.0, 0.0), high=(2.0, 1.0), bins=(5, 3)))
DISCRETE = replace(PENDULUM, action=DiscreteAction(n=3))
SEVERAL = replace(PENDULUM, action=MultiDiscreteAction(nvec=(3, 2)))


def test_discretised_actions_are_equally_spaced_between_the_action_bounds():
    numbers = np.array([[0, 0], [1, 1], [2, 2], [4, 0]])
    np.testing.assert_array_equal(policy_actions(BINS, numbers, 4), [[-2, 0], [-1, 0.5], [0, 1], [2, 0]])


def test_real_queries_and_samples_may_use_actions_between_the_bins():
    np.testing.assert_array_equal(model_actions(BINS, np.array([[0.3, 0.7]])), [[0.3, 0.7]])


def test_one_dimensional_actions_may_be_given_as_a_flat_array():
    np.testing.assert_array_equal(policy_actions(PENDULUM, np.array([1.0, -1.0]), 2), [[1.0], [-1.0]])
    np.testing.assert_array_equal(policy_actions(DISCRETE, np.array([2, 0]), 2), [[2.0], [0.0]])


def test_valid_discrete_actions_of_policies_and_samples_are_not_changed():
    np.testing.assert_array_equal(policy_actions(SEVERAL, np.array([[2, 1], [0, 0]]), 2), [[2, 1], [0, 0]])
    np.testing.assert_array_equal(model_actions(SEVERAL, np.array([[2.0, 1.0]])), [[2, 1]])


def test_an_action_outside_its_bound_by_float32_rounding_is_clipped():
    tenth = replace(PENDULUM, action=BoxAction(low=(-0.1,), high=(0.1,)))
    rounded = np.array([[np.float32(0.1)]], dtype=np.float64)
    assert rounded[0, 0] > 0.1
    assert policy_actions(tenth, rounded, 1)[0, 0] == 0.1
    with pytest.raises(InvalidInput, match=r"entry 0 in \[-0.1, 0.1\], got 0.10001"):
        policy_actions(tenth, np.array([[0.10001]]), 1)


@pytest.mark.parametrize("count", [-1, 3])
def test_a_discrete_action_out_of_range_is_refused_with_its_entry_and_row(count):
    with pytest.raises(InvalidInput, match=rf"entry 0 to be from 0 to 2, got {count} in row 1"):
        policy_actions(DISCRETE, np.array([[0], [count]]), 2)


@pytest.mark.parametrize(
    ("definition", "raw", "complaint"),
    [
        (BOX, np.zeros((2, 3)), r"expected shape \(2, 2\), got \(2, 3\)"),
        (BOX, np.zeros((3, 2)), r"expected shape \(2, 2\), got \(3, 2\)"),
        (BOX, np.zeros(2), r"expected shape \(2, 2\), got \(2,\)"),
        (BOX, np.array([[0, np.nan], [0, 0]]), "finite"),
        (BOX, np.array([[0, np.inf], [0, 0]]), "finite"),
        (BOX, np.array([[0, 0.5], [0, -0.1]]), r"entry 1 in \[0, 1\], got -0.1 in row 1"),
        (BINS, np.array([[0, 0], [5, 0]]), r"entry 0 to be from 0 to 4, got 5 in row 1"),
        (BINS, np.array([[0, 0], [0.5, 0]]), "expected whole numbers, got 0.5"),
        (SEVERAL, np.array([[0, 0], [0, 2]]), r"entry 1 to be from 0 to 1, got 2 in row 1"),
    ],
)
def test_invalid_policy_actions_are_refused(definition, raw, complaint):
    with pytest.raises(InvalidInput, match=complaint):
        policy_actions(definition, raw, 2)


def test_invalid_actions_in_samples_are_refused():
    for definition, raw in ((BINS, [[2.5, 0]]), (DISCRETE, [[1.5]]), (DISCRETE, [[3]]), (BOX, [[np.nan, 0]])):
        with pytest.raises(InvalidInput):
            model_actions(definition, np.array(raw))
