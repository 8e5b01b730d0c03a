"""Families whose models have one form for all outputs: those of this package, and those of installed packages."""

from __future__ import annotations

from surrogym_server.models.bayesian_last_layer import BayesianLastLayers
from surrogym_server.models.ensemble import NetworkEnsembles
from surrogym_server.models.gaussian_process import GaussianProcesses
from surrogym_server.models.port import Learner
from surrogym_server.models.sparse_gaussian_process import SparseGaussianProcesses
from surrogym_server.plugins import Registry

GROUP, NOUN = "surrogym.models", "model family"
GAUSSIAN_PROCESS, SPARSE_GAUSSIAN_PROCESS, ENSEMBLE = "gaussian_process", "sparse_gaussian_process", "ensemble"
BAYESIAN_LAST_LAYER = "bayesian_last_layer"
BUILT_IN: dict[str, type[Learner] | str] = {
    GAUSSIAN_PROCESS: GaussianProcesses,
    SPARSE_GAUSSIAN_PROCESS: SparseGaussianProcesses,
    ENSEMBLE: NetworkEnsembles,
    BAYESIAN_LAST_LAYER: BayesianLastLayers,
}

SINGLES: Registry[Learner] = Registry("candidate", GROUP, Learner, BUILT_IN, noun=NOUN)
