"""SparseGaussianProcesses: processes through inducing points, as a family for the registry of models."""

from __future__ import annotations

from dataclasses import dataclass

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.gp import subsets
from surrogym_server.models.gaussian_process.learning.learn import learn
from surrogym_server.models.gaussian_process.settings import Settings
from surrogym_server.models.port import Learned, Learner, ModelCodec, Warm
from surrogym_server.models.setting_checks import require_whole
from surrogym_server.models.sparse_gaussian_process.codec import SparseGaussianProcessCodec
from surrogym_server.models.sparse_gaussian_process.learning import ByBound
from surrogym_server.models.sparse_gaussian_process.model import SparseGaussianProcessModel

FEWEST, MOST = 10, 2_000  # inducing points


@dataclass(frozen=True)
class SparseGaussianProcesses(Settings, Learner):
    """One process for each output through at most ``inducing`` points. Its structure is chosen as that of exact
    processes. The warm start is hyperparameters.

    Attributes:
        inducing: most inducing points of a process; with so few samples it is exact.
    """

    inducing: int = 300

    def __post_init__(self) -> None:
        super().__post_init__()
        require_whole("inducing", self.inducing, FEWEST, MOST)

    @property
    def exact(self) -> int:
        """Samples up to which the family is that of exact processes."""
        return max(subsets.FEW, self.inducing)

    @property
    def codec(self) -> ModelCodec:
        return SparseGaussianProcessCodec()

    def learn(self, definition: EnvironmentDefinition, samples: Samples, warm: Warm | None = None) -> Learned:
        learned = learn(self, definition, samples, warm or {}, ByBound(self.inducing))
        return Learned(SparseGaussianProcessModel.of(learned.model), learned.warm)
