"""The family of models that are ensembles of neural networks, for the registry of models."""

from __future__ import annotations

from dataclasses import dataclass

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.models.ensemble.codec import MAX_MEMBERS, MAX_UNITS, NetworkEnsembleCodec
from surrogym_server.models.ensemble.learning import learn
from surrogym_server.models.ensemble.training import Training
from surrogym_server.models.port import Learned, Learner, ModelCodec, Warm
from surrogym_server.models.setting_checks import require_number, require_whole

LARGEST = {"members": MAX_MEMBERS, "units": MAX_UNITS, "steps": 5_000, "seed": 2**31}
LEAST = {"members": 2, "units": 1, "steps": 1, "seed": 0}


@dataclass(frozen=True)
class NetworkEnsembles(Learner):
    """Learner of ensembles: networks with two hidden layers, each regularised towards its own random initial weights,
    and networks that predict the noise at each state.

    A fit never starts at the result of an earlier fit: networks whose training continues would fit the first samples
    better than later ones.

    Attributes:
        members: number of networks.
        units: number of units of each hidden layer.
        steps: number of steps of gradient descent.
        seed: seed of initial weights and of batches.
        beta: weighting of the samples in the likelihood, from 0 to 1. With 0, samples with much predicted noise hardly
            influence the mean; with 1, all samples influence the mean equally.
    """

    members: int = 5
    units: int = 32
    steps: int = 600
    seed: int = 0
    beta: float = 0.0

    def __post_init__(self) -> None:
        for name, largest in LARGEST.items():
            require_whole(name, getattr(self, name), LEAST[name], largest)
        require_number("beta", self.beta, 1)

    @property
    def codec(self) -> ModelCodec:
        return NetworkEnsembleCodec()

    def learn(self, definition: EnvironmentDefinition, samples: Samples, warm: Warm | None = None) -> Learned:
        del warm
        training = Training(self.members, self.units, self.steps, self.seed, self.beta)
        return Learned(learn(training, definition, samples), {})
