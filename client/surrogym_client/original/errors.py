"""What can go wrong beside the original environment.

OriginalError
├── UnknownEnvironment      nothing can be made of this name, or no specification can express it
├── NotPerturbable          its masses, lengths and limits are unknown here
├── NotSettable             it can only be reset and acted on
├── NotRenderable           no picture of its states can be made here
└── StepFailed              the environment did not give a step; the query fails, the worker goes on
    ├── StepTimedOut        it took longer than its limit and was killed; the next step starts a fresh one
    └── EnvironmentDied     its process ended; the next step starts a fresh one
"""

from __future__ import annotations


class OriginalError(Exception):
    """Base of this tree. ``str(error)`` is one sentence for a person."""


class UnknownEnvironment(OriginalError):
    """No original environment can be made of this name."""


class NotPerturbable(OriginalError):
    """Only environments with a built-in adapter can be perturbed."""


class NotSettable(OriginalError):
    """The environment can't be set to a state: an episode can only begin with a reset."""


class NotRenderable(OriginalError):
    """The environment has no renderer, it can't run here, or what is observed does not tell the state."""


class StepFailed(OriginalError):
    """The environment raised, or gave something that is no step."""


class StepTimedOut(StepFailed):
    """The environment took longer than its limit."""


class EnvironmentDied(StepFailed):
    """The environment's process ended."""
