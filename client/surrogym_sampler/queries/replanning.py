"""Actions of a query that are planned anew at each step, in the process that has the machine."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from surrogym_client.environments.file_factories import planner_of
from surrogym_client.transport.api import Api
from surrogym_shared.port import HORIZON
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.surrogate_file import RealSamples, SurrogateFile


def replanning(api: Api, surrogate: str, spec: EnvironmentSpec) -> Callable[[NDArray[np.float64]], Sequence[float]]:
    """Return a function from a state (C,) to the action (F,) that a planner on a surrogate's latest model takes there.

    The model is downloaded first, so the steps need no network. The planner is then made, in some seconds.

    Raises:
        SurrogymClientError: the server can't be reached, or has no model.
        ImportError, TypeError, ValueError: this installation, the model or the environment does not allow planning.
    """
    model = api.export_model(surrogate, api.model(surrogate).version)
    samples = RealSamples.none(len(spec.coordinates), spec.action.size)
    planner = planner_of(SurrogateFile(surrogate, spec, model, samples).to_bytes(), HORIZON, spec.design.seed)
    return lambda state: planner.from_states(np.asarray(state, dtype=np.float64)[None])[0].tolist()
