"""Families of models by name: those of this package, and those of installed packages."""

from __future__ import annotations

from surrogym_server.models.ensemble import NetworkEnsembles
from surrogym_server.models.gaussian_process import GaussianProcesses
from surrogym_server.models.port import Learner
from surrogym_server.models.sparse_gaussian_process import SparseGaussianProcesses
from surrogym_server.plugins import Choice, Registry

GAUSSIAN_PROCESS, SPARSE_GAUSSIAN_PROCESS = "gaussian_process", "sparse_gaussian_process"
PROCESSES = (GAUSSIAN_PROCESS, SPARSE_GAUSSIAN_PROCESS)  # families with the settings of Gaussian processes
BUILT_IN: dict[str, type[Learner] | str] = {
    GAUSSIAN_PROCESS: GaussianProcesses,
    SPARSE_GAUSSIAN_PROCESS: SparseGaussianProcesses,
    "ensemble": NetworkEnsembles,
}

MODELS: Registry[Learner] = Registry("model", "surrogym.models", Learner, BUILT_IN, noun="model family")


def learner_of(choice: Choice) -> Learner:
    """Return the learner with a family's name and settings. Raises ``InvalidSpec``."""
    return MODELS.make(choice)
