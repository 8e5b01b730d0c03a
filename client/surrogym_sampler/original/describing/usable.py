"""Checks that refuse an environment which no specification can express, if possible before its real steps.

Shapes: n steps, R resets, V variables of the state.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.errors import UnknownEnvironment
from surrogym_sampler.original.protocol import Array
from surrogym_sampler.original.simulator import Variable
from surrogym_shared.spec import MAX_DIMENSIONS

OWN_CLASS = "in a class of your own (docs/how-to/own-environment.md)"


def require_variables(name: str, variables: Sequence[Variable]) -> None:
    """Raise ``UnknownEnvironment`` if the state of an environment has no variables."""
    if not variables:
        raise UnknownEnvironment(
            f"{name} has no state that can be read, and its observation is empty: expected a state of 1 to "
            f"{MAX_DIMENSIONS} numbers; declare them {OWN_CLASS}"
        )


def require_few(name: str, variables: Sequence[Variable], moved: NDArray[np.bool_]) -> None:
    """Raise ``UnknownEnvironment`` if too many variables moved; ``moved`` (V,) marks those that did among the
    V variables.

    Variables that a drafted specification may leave out don't count: those that are held through an episode, and slides
    without limits.
    """
    needed = np.array([v.motion != "held" and (v.motion != "slide" or v.limited) for v in variables])
    _require_at_most(name, int((moved & needed).sum()))


def require_numbers(name: str, states: Sequence[Array], rewards: Array) -> None:
    """Raise ``UnknownEnvironment`` if states, arrays (n, V) of V variables, or rewards (n,) are infinite or NaN."""
    if not all(np.isfinite(some).all() for some in states):
        raise UnknownEnvironment(
            f"{name} reached states with infinite values or NaN: expected finite numbers; narrow the "
            "bounds of its actions, or correct the environment"
        )
    if not np.isfinite(rewards).all():
        raise UnknownEnvironment(
            f"{name} gave infinite rewards or NaN under random actions: expected finite numbers; correct its reward"
        )


def require_coordinates(name: str, count: int, steps: int) -> None:
    """Raise ``UnknownEnvironment`` if a description would have no coordinates, or too many.

    Args:
        name: the environment.
        count: number of variables that would become coordinates.
        steps: number of random steps that were taken.
    """
    if not count:
        raise UnknownEnvironment(
            f"no variable of {name} differed between resets or moved in {steps} random steps: expected at least one "
            f"that does; take more steps (--steps), or declare the coordinates {OWN_CLASS}"
        )
    _require_at_most(name, count)


def _require_at_most(name: str, count: int) -> None:
    if count > MAX_DIMENSIONS:
        raise UnknownEnvironment(
            f"{name} has {count} variables that move: expected at most {MAX_DIMENSIONS}; choose those that "
            f"the next state depends on, and declare them {OWN_CLASS}"
        )
