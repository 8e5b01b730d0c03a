"""The family of models that consist of Gaussian processes, for the registry of models."""

from __future__ import annotations

from dataclasses import dataclass

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.models.abilities import TakesPrior
from surrogym_server.models.gaussian_process.codec.model import GaussianProcessCodec
from surrogym_server.models.gaussian_process.learning.learn import learn
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.settings import Settings
from surrogym_server.models.port import DynamicsModel, Learned, Learner, ModelCodec, Warm


@dataclass(frozen=True)
class GaussianProcesses(Settings, Learner, TakesPrior):
    """Learner of one Gaussian process for each output. The structure of each process, such as its inputs, is chosen by
    evidence. A fit can start at the hyperparameters of an earlier fit (warm start)."""

    @property
    def codec(self) -> ModelCodec:
        return GaussianProcessCodec()

    def learn(self, definition: EnvironmentDefinition, samples: Samples, warm: Warm | None = None) -> Learned:
        return learn(self, definition, samples, warm or {})

    def learn_beside(
        self, prior: DynamicsModel, definition: EnvironmentDefinition, samples: Samples, warm: Warm | None = None
    ) -> Learned:
        if not isinstance(prior, GaussianProcessModel):
            raise TypeError(
                f"expected a prior of Gaussian processes, got {type(prior).__name__}; learn the prior with the same "
                "model family"
            )
        return learn(self, definition, samples, warm or {}, prior)
