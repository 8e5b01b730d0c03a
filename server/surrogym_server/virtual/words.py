"""The random generator Philox in compiled code. It returns the same integers as the reference, ``virtual.philox``."""

from __future__ import annotations

import numpy as np
from numba import types
from numpy.typing import NDArray

from surrogym_server.virtual.philox import MULTIPLIERS, ROUNDS, WEYL
from surrogym_shared.compiled.jit import entry

Ints = NDArray[np.int64]

FIRST, SECOND = (np.uint64(m) for m in MULTIPLIERS)
FIRST_WEYL, SECOND_WEYL = (np.uint64(w) for w in WEYL)
LOW, HALF = np.uint64(0xFFFFFFFF), np.uint64(32)


@entry(
    types.int64[:],
    types.int64[:],
    types.int64[:],
    types.int64[:],
    types.int64[:, :, ::1],
)
def fill(seed: Ints, lane: Ints, episode: Ints, third: Ints, words: Ints) -> None:
    """Fill ``words`` (N, I, 4) with random 32-bit words, I times four for each of N lanes.

    The i-th four words of lane n have the counter (lane[n], episode[n], third[n], i) and the key ``seed[n]``. ``third``
    combines the number of the step and the purpose of the random numbers.
    """
    for n in range(len(words)):
        key0, key1 = np.uint64(seed[n]) & LOW, (np.uint64(seed[n]) >> HALF) & LOW
        for i in range(words.shape[1]):
            c0, c1 = np.uint64(lane[n]) & LOW, np.uint64(episode[n]) & LOW
            c2, c3 = np.uint64(third[n]), np.uint64(i)
            k0, k1 = key0, key1
            for _ in range(ROUNDS):
                one, other = FIRST * c0, SECOND * c2
                c0, c1, c2, c3 = (other >> HALF) ^ c1 ^ k0, other & LOW, (one >> HALF) ^ c3 ^ k1, one & LOW
                k0, k1 = (k0 + FIRST_WEYL) & LOW, (k1 + SECOND_WEYL) & LOW
            words[n, i, 0], words[n, i, 1] = np.int64(c0), np.int64(c1)
            words[n, i, 2], words[n, i, 3] = np.int64(c2), np.int64(c3)
