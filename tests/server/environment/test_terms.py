"""Terms are the sums that their parts say, and a definition's groups end episodes as inequalities read."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from surrogym_server.environment.conditions import InequalityDefinition
from surrogym_server.environment.definition import EnvironmentDefinition, wrap
from surrogym_server.environment.terms import PartDefinition, TermDefinition, compile_terms

COORDINATES = 3
numbers = st.floats(-4, 4, width=32)
weights = st.tuples(*[st.sampled_from([0.0, 1.0, -1.0, 0.5, 2.0])] * COORDINATES)
part = st.builds(PartDefinition, st.sampled_from(["one", "linear", "sin", "cos"]), numbers, weights)
limits = st.tuples(st.floats(-3, 0), st.floats(0.5, 3)) | st.just((-math.inf, math.inf))
term = st.builds(
    lambda parts, limit: TermDefinition(tuple(parts), *limit),
    st.lists(part, min_size=1, max_size=5),
    limits,
)


def by_hand(term: TermDefinition, q: tuple[float, ...]) -> float:
    total = 0.0
    for p in term.parts:
        phase = sum(a * b for a, b in zip(p.weights, q, strict=True))
        function = {"one": lambda _: 1.0, "linear": float, "sin": math.sin, "cos": math.cos}[p.function]
        total += p.coefficient * function(phase)
    return min(max(total, term.low), term.high)


@given(terms=st.lists(term, min_size=1, max_size=4), points=st.lists(st.tuples(*[numbers] * 3), min_size=1))
def test_compiled_terms_equal_the_sum_computed_by_hand(terms, points):
    values = compile_terms(terms, COORDINATES)(torch.tensor(points, dtype=torch.float64))
    assert values.shape == (len(points), len(terms))
    expected = [[by_hand(t, q) for t in terms] for q in points]
    torch.testing.assert_close(values, torch.tensor(expected, dtype=torch.float64), rtol=1e-9, atol=1e-9)


def test_compiled_terms_keep_leading_batch_dimensions():
    compiled = compile_terms([TermDefinition((PartDefinition("sin", 2.0, (1.0, 0.0, 0.0)),))], COORDINATES)
    assert compiled(torch.zeros(4, 5, 3, dtype=torch.float64)).shape == (4, 5, 1)


@given(angle=st.floats(-1e3, 1e3))
def test_wrapping_an_angle_changes_it_by_whole_turns_into_plus_minus_pi(angle):
    wrapped = float(wrap(torch.tensor(angle, dtype=torch.float64)))
    assert -math.pi <= wrapped <= math.pi
    turns = (angle - wrapped) / (2 * math.pi)
    assert turns == pytest.approx(round(turns), abs=1e-9)


def test_a_half_turn_wraps_to_minus_pi():
    torch.testing.assert_close(wrap(torch.tensor([math.pi, -math.pi])), torch.tensor([-math.pi, -math.pi]))


def x_is(relation, value):
    return InequalityDefinition(TermDefinition((PartDefinition("linear", 1.0, (1.0, 0.0)),)), relation, value)


def speed_is(relation, value):
    return InequalityDefinition(TermDefinition((PartDefinition("linear", 1.0, (0.0, 1.0)),)), relation, value)


@pytest.mark.parametrize(
    ("relation", "ends"),
    [("<", [1, 0, 0]), ("<=", [1, 1, 0]), (">", [0, 0, 1]), (">=", [0, 1, 1])],
)
def test_each_inequality_relation_is_evaluated_exactly_at_its_bound(
    pendulum_definition: EnvironmentDefinition, relation, ends
):
    definition = replace(pendulum_definition, termination_groups=((x_is(relation, 1.0),),))
    q = torch.tensor([[0.5, 0.0], [1.0, 0.0], [1.5, 0.0]], dtype=torch.float64)
    assert definition.terminated(q).tolist() == [bool(e) for e in ends]


def test_an_episode_terminates_when_all_conditions_of_any_group_hold(pendulum_definition: EnvironmentDefinition):
    groups = ((x_is(">", 1.0), speed_is(">", 0.0)), (speed_is("<", -5.0),))
    definition = replace(pendulum_definition, termination_groups=groups)
    q = torch.tensor([[2.0, 1.0], [2.0, -1.0], [0.0, 1.0], [0.0, -6.0]], dtype=torch.float64)
    assert definition.terminated(q).tolist() == [True, False, False, True]
    assert not pendulum_definition.terminated(q).any()
