"""Families of models by name: those of this package, and those of installed packages."""

from __future__ import annotations

from surrogym_server.models.ensemble import NetworkEnsembles
from surrogym_server.models.gaussian_process import GaussianProcesses
from surrogym_server.models.port import Learner
from surrogym_server.plugins import Choice, Registry

GAUSSIAN_PROCESS = "gaussian_process"
SHORT: dict[str, Choice] = {
    "sparse_gaussian_process": Choice(GAUSSIAN_PROCESS, (("inducing", 300),))
}  # see ``in_full``
BUILT_IN: dict[str, type[Learner] | str] = {
    GAUSSIAN_PROCESS: GaussianProcesses,
    "ensemble": NetworkEnsembles,
}

MODELS: Registry[Learner] = Registry("model", "surrogym.models", Learner, BUILT_IN, noun="model family")


def learner_of(choice: Choice) -> Learner:
    """Return the learner with a family's name and settings. Raises ``InvalidSpec``."""
    return MODELS.make(choice)


def in_full(choice: Choice) -> Choice:
    """Return a choice by a name that stands for a family with some settings, as this family; any other as it is."""
    if (short := SHORT.get(choice.name.casefold())) is None:
        return choice
    return Choice(short.name, tuple({**dict(short.settings), **dict(choice.settings)}.items()))
