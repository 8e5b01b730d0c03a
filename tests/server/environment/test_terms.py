"""Terms are the sums that their parts say, and a definition's groups end episodes as inequalities read."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from surrogym_server.environment.definition import EnvironmentDefinition, wrap
from surrogym_server.environment.terms import compile_terms
from surrogym_shared.spec import Inequality, Part, Term, ends_of

NAMES = ("x", "y", "z")
numbers = st.floats(-4, 4, width=32)
weights = st.dictionaries(st.sampled_from(NAMES), st.sampled_from([0.0, 1.0, -1.0, 0.5, 2.0]), min_size=1)
part = st.builds(
    lambda function, coefficient, weights: Part(
        function=function, coefficient=coefficient, weights={} if function == "one" else weights
    ),
    st.sampled_from(["one", "linear", "sin", "cos"]),
    numbers,
    weights,
)
limits = st.tuples(st.none() | st.floats(-3, 0), st.none() | st.floats(0.5, 3))
term = st.builds(
    lambda parts, limit: Term(parts=tuple(parts), low=limit[0], high=limit[1]),
    st.lists(part, min_size=1, max_size=5),
    limits,
)


def by_hand(term: Term, q: tuple[float, ...]) -> float:
    total = 0.0
    for p in term.parts:
        phase = sum(p.weights.get(name, 0.0) * value for name, value in zip(NAMES, q, strict=True))
        function = {"one": lambda _: 1.0, "linear": float, "sin": math.sin, "cos": math.cos}[p.function]
        total += p.coefficient * function(phase)
    low, high = ends_of(term.low, term.high)
    return min(max(total, low), high)


@given(terms=st.lists(term, min_size=1, max_size=4), points=st.lists(st.tuples(*[numbers] * 3), min_size=1))
def test_compiled_terms_equal_the_sum_computed_by_hand(terms, points):
    values = compile_terms(terms, NAMES)(torch.tensor(points, dtype=torch.float64))
    assert values.shape == (len(points), len(terms))
    expected = [[by_hand(t, q) for t in terms] for q in points]
    torch.testing.assert_close(values, torch.tensor(expected, dtype=torch.float64), rtol=1e-9, atol=1e-9)


def test_compiled_terms_keep_leading_batch_dimensions():
    compiled = compile_terms([2 * Term.sin(x=1)], NAMES)
    assert compiled(torch.zeros(4, 5, 3, dtype=torch.float64)).shape == (4, 5, 1)


@given(angle=st.floats(-1e3, 1e3))
def test_wrapping_an_angle_changes_it_by_whole_turns_into_plus_minus_pi(angle):
    wrapped = float(wrap(torch.tensor(angle, dtype=torch.float64)))
    assert -math.pi <= wrapped <= math.pi
    turns = (angle - wrapped) / (2 * math.pi)
    assert turns == pytest.approx(round(turns), abs=1e-9)


def test_a_half_turn_wraps_to_minus_pi():
    torch.testing.assert_close(wrap(torch.tensor([math.pi, -math.pi])), torch.tensor([-math.pi, -math.pi]))


def angle_is(relation, value):
    return Inequality(term=Term.linear(theta=1), relation=relation, value=value)


def speed_is(relation, value):
    return Inequality(term=Term.linear(speed=1), relation=relation, value=value)


@pytest.mark.parametrize(
    ("relation", "ends"),
    [("<", [1, 0, 0]), ("<=", [1, 1, 0]), (">", [0, 0, 1]), (">=", [0, 1, 1])],
)
def test_each_inequality_relation_is_evaluated_exactly_at_its_bound(
    pendulum_definition: EnvironmentDefinition, relation, ends
):
    definition = replace(pendulum_definition, termination_groups=((angle_is(relation, 1.0),),))
    q = torch.tensor([[0.5, 0.0], [1.0, 0.0], [1.5, 0.0]], dtype=torch.float64)
    assert definition.terminated(q).tolist() == [bool(e) for e in ends]


def test_an_episode_terminates_when_all_conditions_of_any_group_hold(pendulum_definition: EnvironmentDefinition):
    groups = ((angle_is(">", 1.0), speed_is(">", 0.0)), (speed_is("<", -5.0),))
    definition = replace(pendulum_definition, termination_groups=groups)
    q = torch.tensor([[2.0, 1.0], [2.0, -1.0], [0.0, 1.0], [0.0, -6.0]], dtype=torch.float64)
    assert definition.terminated(q).tolist() == [True, False, False, True]
    assert not pendulum_definition.terminated(q).any()
