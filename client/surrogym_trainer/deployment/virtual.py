"""Episodes in the virtual environment whose states can be read, because a controller measures states and not
observations."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_client.environments.lanes import Lanes, session_request
from surrogym_client.errors import SurrogymClientError
from surrogym_client.transport import Api
from surrogym_client.transport.http_surrogate import HttpSurrogate
from surrogym_sampler.original.episode import Episode, Moment
from surrogym_sampler.original.errors import NotPerturbable, NotSettable
from surrogym_sampler.original.protocol import Array
from surrogym_shared.network import bounds_of
from surrogym_shared.spec import EnvironmentSpec


class VirtualEpisode(Episode):
    """An episode of a surrogate, in a session with one environment. Each step makes a second request, for the state."""

    parallel = True

    def __init__(self, port: HttpSurrogate, api: Api) -> None:
        super().__init__(port.spec())
        self._api = api
        self._lanes = Lanes(port, session_request(1, "same_step", {"start_box": 0.0, "start_visited": 0.0}))

    def reset(self, seed: int) -> Moment:
        observation = self._lanes.reset(seed).observation[0]
        return Moment(np.asarray(observation), 0.0, False, self._coordinates())

    def step(self, action: Array) -> Moment:
        step = self._lanes.step(_as_sent(self.spec, action)[None])
        if step.lost is not None:
            raise SurrogymClientError(f"the check of the controller lost its session: {step.lost}; start it again")
        result = step.result
        ended = bool(result.terminated[0] or result.truncated[0])
        # after the end of an episode the session has already begun the next one, so its state is not read
        at = np.zeros(0) if ended else self._coordinates()
        return Moment(
            np.asarray(result.observation[0]),
            float(result.reward[0]),
            bool(result.terminated[0]),
            at,
            bool(result.truncated[0]),
        )

    def place(self, coordinates: Array) -> Moment:
        raise NotSettable(
            f"a session of a surrogate can't be set to the state {coordinates.tolist()}: it can only be reset, so "
            "begin its episodes at the declared starts"
        )

    def perturb(self, rng: np.random.Generator, sigma: float) -> None:
        del rng, sigma
        raise NotPerturbable("a surrogate can't be perturbed: check the controller without a perturbation")

    def close(self) -> None:
        self._lanes.close()

    def _coordinates(self) -> Array:
        return np.array(self._api.session_coordinates(self._lanes.view.id)[0])


def _as_sent(spec: EnvironmentSpec, action: Array) -> NDArray[Any]:
    """Return an action (F,) of the environment in the form that a session takes: the numbers of the choices, if there
    are choices."""
    counts = np.array(spec.action.policy_counts)
    if not counts.size:
        return action
    low, high = bounds_of(spec)
    index = (action - low) / (high - low) * (counts - 1) if low.size else action
    return np.round(index).astype(np.int64)
