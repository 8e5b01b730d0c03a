"""Equal fits of a worker are made once: hundreds of designs begin with the same samples of a Pendulum.

A fit depends on its definition, its samples and its warm start alone, as ``learning_twice_gives_the_same_model`` of the
laws of families tests.
"""

from __future__ import annotations

import pickle

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.models.guard import learn
from surrogym_server.models.port import DynamicsModel, Learned, Warm

_made: dict[tuple[bytes, str, bytes], Learned] = {}


def learn_once(
    definition: EnvironmentDefinition, samples: Samples, warm: Warm | None, prior: DynamicsModel | None = None
) -> Learned:
    """``learn`` of the guard. Families of tests may do something else each time, so only the default is remembered."""
    if definition.learning.model.name != "gaussian_process" or prior is not None:
        return learn(definition, samples, warm, prior)
    key = pickle.dumps(definition), samples.digest, pickle.dumps(sorted((warm or {}).items(), key=lambda item: item[0]))
    if key not in _made:
        _made[key] = learn(definition, samples, warm)
    return _made[key]
