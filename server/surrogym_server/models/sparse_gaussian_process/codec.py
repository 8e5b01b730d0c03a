"""SparseGaussianProcessCodec: the arrays are those of Gaussian processes."""

from __future__ import annotations

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.models.gaussian_process.codec.model import GaussianProcessCodec
from surrogym_server.models.port import DynamicsModel, ModelCodec, StoredModel
from surrogym_server.models.sparse_gaussian_process.model import SparseGaussianProcessModel


class SparseGaussianProcessCodec(ModelCodec):
    def encode(self, model: DynamicsModel) -> StoredModel:
        if not isinstance(model, SparseGaussianProcessModel):
            raise TypeError(f"expected a model of sparse Gaussian processes, got {type(model).__name__}")
        return GaussianProcessCodec().encode(model.plain)

    def decode(self, definition: EnvironmentDefinition, stored: StoredModel) -> SparseGaussianProcessModel:
        return SparseGaussianProcessModel.of(GaussianProcessCodec().decode(definition, stored))
