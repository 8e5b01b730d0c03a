"""What a trainer sees of a session over many steps, to be compared bit for bit."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from surrogym_client.errors import ServerUnreachable
from surrogym_client.transport import HttpSurrogate
from surrogym_shared.wire import OpenSession

LANES, PLANNED = 3, 8
SESSION = OpenSession(num_envs=LANES, seed=3, time_limit=7)


def trajectory(port: HttpSurrogate, steps: int) -> list[np.ndarray]:
    """Everything that a trainer sees in so many steps, and in a rollout at the end."""
    session = port.open(SESSION).id
    actions = np.random.default_rng(1).uniform(-2, 2, (steps, LANES, 1)).astype(np.float32)
    seen = [port.reset(session).observation]
    for action in actions:
        result = port.step(session, action)
        seen += [result.observation, result.reward, result.truncated]
    for result in port.rollout(session, actions[:PLANNED]):
        seen += [result.observation, result.reward, result.truncated]
    with suppress(ServerUnreachable):  # closing is not repeated: what nobody closes expires
        port.close(session)
    return seen
