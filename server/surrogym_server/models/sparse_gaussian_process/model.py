"""SparseGaussianProcessModel: Gaussian processes through inducing points, fitted to one environment."""

from __future__ import annotations

from dataclasses import dataclass, fields

from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.port import DynamicsModel


@dataclass(frozen=True)
class SparseGaussianProcessModel(GaussianProcessModel):
    """A process through inducing points is served, drawn from and extended like an exact one, so all abilities are
    those of exact processes."""

    @classmethod
    def of(cls, model: DynamicsModel) -> SparseGaussianProcessModel:
        """Return a model of Gaussian processes as one of this family."""
        assert isinstance(model, GaussianProcessModel)
        return cls(**{field.name: getattr(model, field.name) for field in fields(GaussianProcessModel)})

    @property
    def plain(self) -> GaussianProcessModel:
        """The same model as one of the family ``gaussian_process``."""
        return GaussianProcessModel(**{field.name: getattr(self, field.name) for field in fields(self)})
