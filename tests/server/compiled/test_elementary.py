"""Elementary functions of compiled code are as exact as those of the C library, also where they are hard."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("numba")

import torch
from numba import njit

from surrogym_server.compiled import elementary
from surrogym_server.environment.definition import wrap

ULPS = 4 * np.finfo(np.float64).eps


def test_the_compiled_exponential_is_exact_to_the_last_digits():
    x = np.concatenate([np.linspace(-700, 700, 20_001), np.geomspace(1e-300, 1, 100), [0.0, -0.0]])
    result = x.copy()
    njit(elementary.exponential.py_func)(result)
    np.testing.assert_allclose(result, np.exp(x), rtol=ULPS)


def test_the_compiled_exponential_of_a_very_negative_number_is_zero():
    x = np.array([-745.0, -1e9, -np.inf])
    njit(elementary.exponential.py_func)(x)
    assert (abs(x) < 1e-300).all()


@pytest.mark.parametrize("largest", [1.0, 1e3, 9e4, 1e8])
def test_the_compiled_sine_and_cosine_are_exact_for_small_and_large_angles(largest: float):
    x = np.concatenate([np.linspace(-largest, largest, 20_001), np.arange(-40, 40) * math.pi / 4])
    sine, cosine = np.empty_like(x), np.empty_like(x)
    njit(elementary.sine_and_cosine.py_func)(x, sine, cosine)
    np.testing.assert_allclose(sine, np.sin(x), rtol=0, atol=ULPS)
    np.testing.assert_allclose(cosine, np.cos(x), rtol=0, atol=ULPS)


def test_the_compiled_sine_of_nan_is_nan():
    x, sine, cosine = np.array([np.nan, 1.0]), np.empty(2), np.empty(2)
    njit(elementary.sine_and_cosine.py_func)(x, sine, cosine)
    assert np.isnan(sine[0])
    assert abs(sine[1] - math.sin(1)) < ULPS


@pytest.mark.parametrize("angle", [0.0, math.pi, -math.pi, 3.2, -3.2, 100.0, -1e6, np.nextafter(-math.pi, -4)])
def test_the_compiled_wrapped_angle_equals_that_of_torch(angle: float):
    expected = wrap(torch.tensor(angle, dtype=torch.float64))
    assert njit(elementary.wrapped.py_func)(angle) == float(expected)
