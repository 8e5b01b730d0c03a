"""Real steps that a machine posts to the server, for a watcher."""

from __future__ import annotations

import time
from collections.abc import Iterator

from surrogym_client.transport.api import Api
from surrogym_client.transport.steps import StepCalls
from surrogym_shared.wire.watching import StreamedStep
from surrogym_trainer.evaluation.comparing import StepOfEpisode

LOOK_SECONDS = 1.0  # seconds between two requests for new steps


def posted(api: Api, surrogate: str, since: float, *, follow: bool) -> Iterator[list[StreamedStep]]:
    """Yield the steps that a machine has posted after the time ``since`` (s since 1970 by the server's clock), in the
    order in which they came, and with ``follow`` the later ones too, without end. Raises ``SurrogymClientError``."""
    calls, last = StepCalls(api.connection), 0
    while True:
        if steps := calls.after(surrogate, last, since):
            last = steps[-1].id
            yield steps
        elif follow:
            time.sleep(LOOK_SECONDS)
        else:
            return


def step_of(one: StreamedStep) -> StepOfEpisode:
    """Return a posted step, whose field ``number`` is its number in its stream."""
    return StepOfEpisode(
        episode=0,
        number=one.number,
        coordinates=tuple(one.coordinates),
        action=tuple(one.action),
        next_coordinates=tuple(one.next_coordinates),
        reward=one.reward,
        terminated=one.terminated,
    )
