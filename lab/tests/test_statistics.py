"""The statistics are those they say they are."""

import numpy as np
import pytest
import scipy.stats

from surrogym_lab.reproduce.statistics import bootstrap_interval, difference_interval, exact_interval


def test_the_bootstrap_interval_has_about_its_nominal_coverage():
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(60):
        low, high = bootstrap_interval(rng.normal(5.0, 2.0, 12))
        inside += low <= 5.0 <= high
    assert 48 <= inside <= 60


def test_the_difference_interval_excludes_zero_only_if_there_is_a_difference():
    rng = np.random.default_rng(1)
    first, second = rng.normal(0.0, 1.0, 10), rng.normal(0.0, 1.0, 10)
    low, high = difference_interval(first, second)
    assert low < 0 < high
    low, high = difference_interval(first + 5, second)
    assert 3 < low < high < 7


def test_the_bootstrap_interval_includes_the_effect_of_a_few_bad_seeds():
    low, high = bootstrap_interval(np.array([-150.0] * 6 + [-1500.0] * 4))
    assert low < -900
    assert high == -150.0


@pytest.mark.parametrize(("count", "of"), [(0, 10), (10, 10), (9, 10), (1, 100), (45, 50)])
def test_the_exact_binomial_interval_equals_that_of_scipy(count, of):
    expected = scipy.stats.binomtest(count, of).proportion_ci(method="exact")
    assert exact_interval(count, of) == pytest.approx((expected.low, expected.high), abs=1e-9)
