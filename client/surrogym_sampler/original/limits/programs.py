"""Programs of fallbacks that limits name: functions that only a person at the machine gives.

Shapes: C coordinates, F action entries.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surrogym_sampler.original.errors import StepFailed, UnknownEnvironment
from surrogym_sampler.original.factories import load_factory
from surrogym_shared.limits import clipped_action
from surrogym_shared.spec import BoxAction, EnvironmentSpec
from surrogym_shared.spec.safety import NamedFallback

Array = NDArray[np.float64]
Program = Callable[[Array], ArrayLike]  # an action (F,) from coordinates (C,)


def program_of(spec: EnvironmentSpec, given: str | None) -> Program | None:
    """Return the program of the fallback that the limits of a specification name; None if they name none.

    Args:
        spec: the specification.
        given: what a person gave, as NAME=package.module:function.

    Raises:
        UnknownEnvironment: no program was given for the name, one for another name, or one that can't be called.
    """
    declared = None if spec.limits is None else spec.limits.fallback
    if not isinstance(declared, NamedFallback):
        if given is not None:
            raise UnknownEnvironment(
                f"--fallback: expected limits that name a fallback, got a specification that names none and {given!r}: "
                "leave it out"
            )
        return None
    name, _, target = (given or "").partition("=")
    if name != declared.name:
        raise UnknownEnvironment(
            f"the limits name the fallback {declared.name!r}: expected --fallback "
            f"{declared.name}=package.module:function, got {given or 'none'}"
        )
    program: Program = load_factory(target)
    return program


def called(program: Program, spec: EnvironmentSpec, coordinates: Array) -> Array:
    """Return the action (F,) that a program chooses at coordinates (C,), clipped to the action's range and, if it is
    discrete, rounded.

    Raises:
        StepFailed: the program does not return F finite numbers.
    """
    action = np.atleast_1d(np.asarray(program(coordinates.copy()), dtype=np.float64))
    if action.shape != (spec.action.size,) or not np.isfinite(action).all():
        raise StepFailed(
            f"expected {spec.action.size} finite numbers from the fallback's program, got {action.tolist()}: correct it"
        )
    return clipped_action(spec, action if isinstance(spec.action, BoxAction) else np.rint(action))
