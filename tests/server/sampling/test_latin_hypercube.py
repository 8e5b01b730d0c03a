"""Every equally probable interval of every dimension has exactly one point; discrete actions are balanced."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import pdist
from scipy.stats import truncnorm

from surrogym_sampler.original.classic import acrobot, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.distributions import Distribution
from surrogym_server.sampling.latin_hypercube import going_on, latin_hypercube, random_points
from surrogym_shared.spec import BoxAction, Coordinate, MultiDiscreteAction, Normal, Uniform, limits

PENDULUM = definition_from_spec(pendulum())

uniform = st.builds(lambda low, width: Uniform(low=low, high=low + width), st.floats(-10, 10), st.floats(0.1, 20))
normal = st.builds(
    lambda mean, std, a, b: Normal(mean=mean, std=std, low=mean - a * std, high=mean + b * std),
    st.floats(-10, 10),
    st.floats(0.1, 5),
    st.floats(0.5, 4),
    st.floats(0.5, 4),
)
actions = st.one_of(
    st.just(BoxAction(low=(-1.0, 0.0), high=(1.0, 5.0))),
    st.builds(lambda n: MultiDiscreteAction(nvec=tuple(n)), st.lists(st.integers(2, 5), max_size=2, min_size=1)),
)


def coordinate(distribution: Uniform | Normal) -> Coordinate:
    return Coordinate(name="x", sampling=distribution)


def probability(distribution: Distribution, values: np.ndarray) -> np.ndarray:
    """Share of the distribution below each value, by other means than its quantiles."""
    low, high = limits(distribution)
    if isinstance(distribution, Uniform):
        return (values - low) / (high - low)
    mean, std = distribution.mean, distribution.std
    return truncnorm((low - mean) / std, (high - mean) / std, loc=mean, scale=std).cdf(values)


def assert_stratified(p: np.ndarray) -> None:
    n = len(p)
    ordered = np.sort(p)
    assert np.all(ordered >= np.arange(n) / n - 1e-9)
    assert np.all(ordered <= (np.arange(n) + 1) / n + 1e-9)


@settings(max_examples=60)
@given(
    distributions=st.lists(uniform | normal, min_size=1, max_size=3),
    action=actions,
    count=st.integers(1, 40),
    seed=st.integers(0, 2**32 - 1),
    tries=st.sampled_from([1, 4]),
)
def test_a_latin_hypercube_has_one_point_per_stratum_of_each_dimension(distributions, action, count, seed, tries):
    definition = replace(PENDULUM, coordinates=tuple(map(coordinate, distributions)), action=action)
    q, u = latin_hypercube(definition, count, np.random.default_rng(seed), tries)
    assert q.shape == (count, len(distributions))
    assert u.shape == (count, action.size)
    for i, distribution in enumerate(distributions):
        assert_stratified(probability(distribution, q[:, i].numpy()))
    for entry, (low, high) in enumerate(() if action.nvec else action.ranges):
        assert_stratified(probability(Uniform(low=low, high=high), u[:, entry].numpy()))
    for entry, n in enumerate(action.nvec):
        counts = np.bincount(u[:, entry].long().numpy(), minlength=n)
        assert len(counts) == n
        assert counts.max() - counts.min() <= (count % n > 0)


def test_latin_hypercube_points_are_random_within_strata_and_uncorrelated():
    q, u = latin_hypercube(PENDULUM, 200, np.random.default_rng(0))
    joint = torch.cat([q, u], 1)
    assert torch.corrcoef(joint.T).fill_diagonal_(0).abs().max() < 0.2
    within = (probability(PENDULUM.coordinates[1].sampling, q[:, 1].numpy()) * 200) % 1
    assert 0.4 < within.mean() < 0.6
    assert within.std() > 0.2


def test_of_several_latin_hypercubes_the_one_with_the_largest_minimum_distance_is_taken():
    def closest(tries: int) -> float:
        q, u = latin_hypercube(PENDULUM, 10, np.random.default_rng(1), tries)
        unit = np.concatenate([q.numpy() / [2 * np.pi, 16], u.numpy() / 4], 1)
        return float(pdist(unit).min())

    assert closest(50) > closest(1)
    assert closest(50) == pytest.approx(max(closest(n) for n in range(1, 51)))


def test_random_points_follow_the_sampling_distributions():
    distribution = Normal(mean=1, std=2, low=-2, high=3)
    definition = replace(PENDULUM, coordinates=(coordinate(distribution),))
    q, u = random_points(definition, 4_000, np.random.default_rng(0))
    p = probability(distribution, q[:, 0].numpy())
    np.testing.assert_allclose(np.quantile(p, [0.1, 0.5, 0.9]), [0.1, 0.5, 0.9], atol=0.03)
    assert -2 <= float(u.min()) < -1.9
    assert 1.9 < float(u.max()) <= 2


def test_points_in_terminal_states_are_redrawn_and_the_others_kept():
    definition = definition_from_spec(acrobot())
    rng = np.random.default_rng(0)
    q, u = random_points(definition, 400, rng)
    over = definition.terminated(q)
    kept_q, kept_u = going_on(definition, q, u, rng)
    assert over.sum() > 20
    assert not definition.terminated(kept_q).any()
    assert torch.equal(kept_q[~over], q[~over])
    assert torch.equal(kept_u[~over], u[~over])


def test_points_are_kept_if_the_whole_sampling_range_is_terminal():
    definition = definition_from_spec(acrobot())
    everywhere = definition.termination_groups[0][0].model_copy(update={"value": -10.0})
    definition = replace(definition, termination_groups=((everywhere,),))
    q, u = random_points(definition, 5, np.random.default_rng(0))
    assert len(going_on(definition, q, u, np.random.default_rng(0))[0]) == 5
