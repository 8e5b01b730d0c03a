"""Families of models by name: those of this package, and those of installed packages."""

from __future__ import annotations

from surrogym_server.models.port import Learner
from surrogym_server.models.selected import SelectedFamilies
from surrogym_server.models.singles import BUILT_IN, GAUSSIAN_PROCESS, GROUP, NOUN, SPARSE_GAUSSIAN_PROCESS
from surrogym_server.plugins import Choice, Registry

SELECTED = "selected"
PROCESSES = (GAUSSIAN_PROCESS, SPARSE_GAUSSIAN_PROCESS, SELECTED)  # families with the settings of Gaussian processes

MODELS: Registry[Learner] = Registry("model", GROUP, Learner, {**BUILT_IN, SELECTED: SelectedFamilies}, noun=NOUN)


def learner_of(choice: Choice) -> Learner:
    """Return the learner with a family's name and settings. Raises ``InvalidSpec``."""
    return MODELS.make(choice)
