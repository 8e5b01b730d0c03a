"""Actions that are chosen at each step, in the process that has the machine, from the state that was measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from surrogym_client.environments.file_factories import planner_of
from surrogym_client.transport.api import Api
from surrogym_shared.integrals import Floats, Integrals, joined
from surrogym_shared.network import Network, bounds_of
from surrogym_shared.port import horizon_of
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.surrogate_file import RealSamples, SurrogateFile
from surrogym_shared.terms import observe

Acting = Callable[[NDArray[np.float64]], Sequence[float]]


def replanning(api: Api, surrogate: str, spec: EnvironmentSpec) -> Acting:
    """Return a function from a state (C,) to the action (F,) that a planner on a surrogate's latest model takes there.

    The model is downloaded first, so the steps need no network. The planner is then made, in some seconds.

    Raises:
        SurrogymClientError: the server can't be reached, or has no model.
        ImportError, TypeError, ValueError: this installation, the model or the environment does not allow planning.
    """
    model = api.export_model(surrogate, api.model(surrogate).version)
    samples = RealSamples.none(len(spec.coordinates), spec.action.size)
    file, fidelity = SurrogateFile(surrogate, spec, model, samples).to_bytes(), api.surrogate(surrogate).fidelity
    noise = {} if fidelity is None else {output.name: output.sensor_noise for output in fidelity.outputs}
    planner = planner_of(file, horizon_of(spec), spec.design.seed, {}, sensor_noise=noise)
    return lambda state: planner.from_states(np.asarray(state, dtype=np.float64)[None])[0].tolist()


def following(policy: bytes, spec: EnvironmentSpec) -> Acting:
    """Return a function from a state (C,) to the action (F,) of a policy, given the content of its file.

    The states are those of one episode, in their order: integrals of errors that the policy sees begin at 0. The file
    contains arrays; nothing is unpickled.

    Raises:
        ValueError: the file is not a network of arrays, or not one for this environment.
    """
    network = Network.load(policy)
    network.require_fit(len(spec.observation), spec.action)
    integrals, (low, high) = Integrals.of(spec, network.integrals), bounds_of(spec)
    sums: Floats | None = None

    def act(state: NDArray[np.float64]) -> Sequence[float]:
        nonlocal sums
        shown = observe(spec, np.asarray(state, dtype=np.float64)[None])
        now = np.zeros((1, len(network.integrals))) if sums is None else integrals.after(sums, shown)
        sums = now
        action = np.reshape(network(joined(shown, now)), -1).astype(np.float64)
        chosen: list[float] = (action if network.counts else np.clip(action, low, high)).tolist()
        return chosen

    return act
