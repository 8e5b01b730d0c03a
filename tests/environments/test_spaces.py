"""Spaces of the wire become the Gymnasium spaces a policy is built for."""

import gymnasium
import numpy as np

from surrogym_client.environments.spaces import space
from surrogym_shared.wire import BoxSpace, DiscreteSpace, MultiDiscreteSpace


def test_a_null_limit_of_a_box_space_becomes_infinite():
    box = space(BoxSpace(low=[-1.5, None], high=[None, 2.0]))
    low, high = np.float32([-1.5, -np.inf]), np.float32([np.inf, 2.0])
    assert box == gymnasium.spaces.Box(low, high, dtype=np.float32)


def test_discrete_and_multi_discrete_spaces_are_converted():
    assert space(DiscreteSpace(n=3)) == gymnasium.spaces.Discrete(3)
    assert space(MultiDiscreteSpace(nvec=[2, 5])) == gymnasium.spaces.MultiDiscrete([2, 5])
