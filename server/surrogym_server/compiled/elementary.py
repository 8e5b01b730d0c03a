"""Elementary functions of whole arrays, in forms that the compiler turns into vector instructions.

Each reduces its argument by a multiple k of log 2 or pi / 2, with k from the low bits of x / step + 1.5 2^52, and takes
a polynomial of what is left. Errors are below 2 units in the last place; the scalar functions of the C library, which
compiled code would call for each entry, take five to ten times as long.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from surrogym_server.compiled.jit import compiled

Floats = NDArray[np.float64]

ROUNDING = 1.5 * 2.0**52  # added to a number below 2^51, leaves it rounded in the low bits
PER_LOG2 = 1.4426950408889634
LOG2_HIGH, LOG2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
LEAST_EXPONENT = -708.0  # e to it is the smallest normal number
PER_RIGHT_ANGLE = 0.63661977236758134
# pi / 2 in three parts, of which the first two have 33 bits, so that their products with k are exact
RIGHT_ANGLE = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
LARGEST_ANGLE = 1e5  # beyond, the C library reduces the argument


@compiled
def exponential(x: Floats) -> None:
    """e^x in the place of x (n,), for x <= 709; below -708 it is about 1e-308."""
    shifted = np.empty_like(x)
    for i in range(x.size):
        v = x[i] if x[i] > LEAST_EXPONENT else LEAST_EXPONENT
        t = v * PER_LOG2 + ROUNDING
        shifted[i] = t
        k = t - ROUNDING
        r = (v - k * LOG2_HIGH) - k * LOG2_LOW
        p = 1.6059043836821613e-10
        p = p * r + 2.08767569878681e-09
        p = p * r + 2.505210838544172e-08
        p = p * r + 2.755731922398589e-07
        p = p * r + 2.7557319223985893e-06
        p = p * r + 2.48015873015873e-05
        p = p * r + 1.984126984126984e-04
        p = p * r + 1.388888888888889e-03
        p = p * r + 8.333333333333333e-03
        p = p * r + 4.1666666666666664e-02
        p = p * r + 1.6666666666666666e-01
        p = p * r + 0.5
        p = p * r + 1.0
        x[i] = p * r + 1.0
    bits, steps = x.view(np.int64), shifted.view(np.int64)
    for i in range(x.size):
        bits[i] += steps[i] << 52  # times 2^k


@compiled
def sine_and_cosine(x: Floats, sine: Floats, cosine: Floats) -> None:
    """sin x and cos x of x (n,), into arrays of the same size."""
    shifted = np.empty_like(x)
    largest = 0.0
    for i in range(x.size):
        largest = max(largest, abs(x[i]))
    if not largest < LARGEST_ANGLE:
        for i in range(x.size):
            sine[i], cosine[i] = math.sin(x[i]), math.cos(x[i])
        return
    for i in range(x.size):
        t = x[i] * PER_RIGHT_ANGLE + ROUNDING
        shifted[i] = t
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
        sine[i] = r + r * z * s
        cosine[i] = 1.0 - (0.5 * z - z * z * c)
    turns = shifted.view(np.int64)
    for i in range(x.size):
        quarter = turns[i]
        s, c = sine[i], cosine[i]
        odd = quarter & 1
        first, second = (c if odd else s), (s if odd else c)
        sine[i] = -first if quarter & 2 else first
        cosine[i] = -second if (quarter + 1) & 2 else second


@compiled
def wrapped(angle: float) -> float:
    """The angle in [-pi, pi), as ``environment.definition.wrap`` gives it."""
    turned = angle + math.pi
    if not 0.0 <= turned < 2 * math.pi:
        turned %= 2 * math.pi
    return turned - math.pi
