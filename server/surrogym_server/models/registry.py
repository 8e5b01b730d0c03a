"""Families of models by name: those of this package, and those of installed packages."""

from __future__ import annotations

from surrogym_server.models.ensemble import NetworkEnsembles
from surrogym_server.models.gaussian_process import GaussianProcesses
from surrogym_server.models.port import Learner
from surrogym_server.plugins import Choice, Registry

GROUP = "surrogym.models"
GAUSSIAN_PROCESS = "gaussian_process"

MODELS: Registry[Learner] = Registry(
    "model",
    GROUP,
    Learner,
    {
        GAUSSIAN_PROCESS: GaussianProcesses,
        "ensemble": NetworkEnsembles,
    },
    noun="model family",
)


def learner_of(choice: Choice) -> Learner:
    """Return the learner with a family's name and settings. Raises ``InvalidSpec``."""
    return MODELS.make(choice)
