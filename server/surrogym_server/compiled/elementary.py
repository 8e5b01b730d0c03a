"""Elementary functions of whole arrays, in forms that the compiler can turn into vector instructions.

Each function subtracts k times a step of log 2 or pi / 2 from its argument x, and evaluates a polynomial of the rest. k
is in the low bits of x / step + 1.5 2^52. Errors are below 2 units in the last place. The functions of the C library,
which compiled code would otherwise call for each entry, take five to ten times as long.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from surrogym_shared.compiled.jit import compiled, summing

Floats = NDArray[np.float64]

# If this is added to a float64 x with |x| < 2^51, the low bits of the sum are x, rounded to an integer.
ROUNDING = 1.5 * 2.0**52
PER_LOG2 = 1.4426950408889634  # 1 / log 2
# Two numbers whose sum is log 2. The first has so few bits that its product with a whole number k is exact.
LOG2_HIGH, LOG2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
LEAST_EXPONENT = -708.0  # lower exponents are raised to this one: e^-708 is about the smallest normal float64
PER_RIGHT_ANGLE = 0.63661977236758134  # 2 / pi
# pi / 2 in three parts, of which the first two have 33 bits, so that their products with a whole number k are exact
RIGHT_ANGLE = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
LARGEST_ANGLE = 1e5  # an array with a larger angle is computed by the C library, which reduces angles exactly


def _keep_bits(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.bitcast(arguments[0], context.get_value_type(signature.return_type))


def _bits_of(_: Any, _number: Any) -> Any:
    return types.int64(types.float64), _keep_bits


def _float_of(_: Any, _bits: Any) -> Any:
    return types.float64(types.int64), _keep_bits


bits_of: Any = intrinsic(_bits_of)  # function for compiled code: reinterprets the bits of a float64 as an int64
float_of: Any = intrinsic(_float_of)  # function for compiled code: reinterprets the bits of an int64 as a float64


@compiled
def exponential(x: Floats) -> None:
    """Replace each of n entries of x (n,) by its exponential, in place. Entries must be at most 709. For an entry below
    -708, the result is about 1e-308."""
    for i in range(x.size):
        v = x[i] if x[i] > LEAST_EXPONENT else LEAST_EXPONENT
        t = v * PER_LOG2 + ROUNDING
        k = t - ROUNDING
        r = (v - k * LOG2_HIGH) - k * LOG2_LOW
        # Polynomial for (e^r - 1) / r, with |r| <= log(2) / 2. Its coefficients but the last interpolate
        # (e^r - 1 - r) / r^2 at Chebyshev nodes, with an error of 1e-17.
        p = 2.510038549551032e-08
        p = p * r + 2.7620088445409746e-07
        p = p * r + 2.7557268459997064e-06
        p = p * r + 2.4801521295954376e-05
        p = p * r + 0.00019841269863053618
        p = p * r + 0.0013888888917213717
        p = p * r + 0.008333333333330062
        p = p * r + 0.04166666666662413
        p = p * r + 0.16666666666666669
        p = p * r + 0.5000000000000001
        p = p * r + 1.0
        # The integer k in the low bits of t is added to the exponent bits of e^r, which multiplies e^r by 2^k.
        x[i] = float_of(bits_of(p * r + 1.0) + (bits_of(t) << 52))


@compiled
def sine_and_cosine(x: Floats, sine: Floats, cosine: Floats) -> None:
    """Write the sines and cosines of x (n,) to the arrays ``sine`` and ``cosine`` of the same size."""
    large = False
    for i in range(x.size):
        large |= not abs(x[i]) < LARGEST_ANGLE
    if large:
        for i in range(x.size):
            sine[i], cosine[i] = math.sin(x[i]), math.cos(x[i])
        return
    for i in range(x.size):
        t = x[i] * PER_RIGHT_ANGLE + ROUNDING
        k = t - ROUNDING
        r = ((x[i] - k * RIGHT_ANGLE[0]) - k * RIGHT_ANGLE[1]) - k * RIGHT_ANGLE[2]
        z = r * r
        s = 1.58969099521155010221e-10
        s = s * z - 2.50507602534068634195e-08
        s = s * z + 2.75573137070700676789e-06
        s = s * z - 1.98412698298579493134e-04
        s = s * z + 8.33333333332248946124e-03
        s = s * z - 1.66666666666666324348e-01
        c = -1.13596475577881948265e-11
        c = c * z + 2.08757232129817482790e-09
        c = c * z - 2.75573143513906633035e-07
        c = c * z + 2.48015872894767294178e-05
        c = c * z - 1.38888888888741095749e-03
        c = c * z + 4.16666666666666019037e-02
        s, c = r + r * z * s, 1.0 - (0.5 * z - z * z * c)
        quarter = bits_of(t)
        first, second = (c, s) if quarter & 1 else (s, c)
        sine[i] = -first if quarter & 2 else first
        cosine[i] = -second if (quarter + 1) & 2 else second


@compiled
def wrapped(angle: float) -> float:
    """Return an angle in radians, wrapped to [-pi, pi), as ``environment.definition.wrap`` does."""
    turned = angle + math.pi
    if not 0.0 <= turned < 2 * math.pi:
        turned %= 2 * math.pi
    return turned - math.pi


@summing
def dot(a: Floats, b: Floats) -> float:
    """Return the scalar product of a (n,) and b (n,). The compiler may sum in any order, to vectorise the sum."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total
