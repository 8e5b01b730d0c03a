"""Registry of model families: those of this package, and those that installed plugins add."""

from __future__ import annotations

from surrogym_server.models.ensemble import NetworkEnsembles
from surrogym_server.models.gaussian_process import GaussianProcesses
from surrogym_server.models.port import Learner
from surrogym_server.plugins import Choice, Registry

GAUSSIAN_PROCESS = "gaussian_process"
# Short names that a specification may use. Each stands for a family with certain settings.
SHORT: dict[str, Choice] = {"sparse_gaussian_process": Choice(GAUSSIAN_PROCESS, (("inducing", 300),))}
BUILT_IN: dict[str, type[Learner] | str] = {
    GAUSSIAN_PROCESS: GaussianProcesses,
    "ensemble": NetworkEnsembles,
}

MODELS: Registry[Learner] = Registry("model", "surrogym.models", Learner, BUILT_IN, noun="model family")


def learner_of(choice: Choice) -> Learner:
    """Return the learner of a chosen family and its settings. Raises ``InvalidSpec`` for an unknown name or setting."""
    return MODELS.make(choice)


def in_full(choice: Choice) -> Choice:
    """Replace a short name by the family and the settings for which it stands.

    Settings in ``choice`` override those of the short name. A choice with any other name is returned unchanged.
    """
    if (short := SHORT.get(choice.name.casefold())) is None:
        return choice
    return Choice(short.name, tuple({**dict(short.settings), **dict(choice.settings)}.items()))
