"""BayesianLastLayers: networks with Bayesian last layers, as a family for the registry of models."""

from __future__ import annotations

from dataclasses import dataclass

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.models.bayesian_last_layer.codec import (
    MAX_MEMBERS,
    MAX_UNITS,
    MAX_WAVES,
    BayesianLastLayerCodec,
)
from surrogym_server.models.bayesian_last_layer.learning import learn
from surrogym_server.models.bayesian_last_layer.training import Training
from surrogym_server.models.port import Learned, Learner, ModelCodec, Warm
from surrogym_server.models.setting_checks import require_whole

LARGEST = {"networks": MAX_MEMBERS, "units": MAX_UNITS, "waves": MAX_WAVES, "iterations": 5_000, "seed": 2**31}
LEAST = {"networks": 1, "units": 1, "waves": 0, "iterations": 1, "seed": 0}


@dataclass(frozen=True)
class BayesianLastLayers(Learner):
    """A few networks for each output, whose last layers are exact Bayesian linear regressions on hidden units and
    random waves. The warm start is what the last fit has trained: hidden weights and variances.

    The settings are not called ``members`` and ``steps``, because ``selected`` passes its own on to all candidates that
    have settings of these names, and an ensemble needs more of both.

    Attributes:
        networks: number of networks of each output.
        units: of each hidden layer.
        waves: random Fourier features beside the hidden units.
        iterations: of gradient ascent.
        seed: of initial weights, waves and batches.
    """

    networks: int = 4
    units: int = 32
    waves: int = 64
    iterations: int = 300
    seed: int = 0

    def __post_init__(self) -> None:
        for name, largest in LARGEST.items():
            require_whole(name, getattr(self, name), LEAST[name], largest)

    @property
    def codec(self) -> ModelCodec:
        return BayesianLastLayerCodec()

    def learn(self, definition: EnvironmentDefinition, samples: Samples, warm: Warm | None = None) -> Learned:
        training = Training(self.networks, self.units, self.waves, self.iterations, self.seed)
        return learn(training, definition, samples, warm or {})
