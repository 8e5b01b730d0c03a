"""Checks of a design's arguments.

Each check returns the value, or raises ``InvalidInput`` with what was expected and what came.

Shapes: C coordinates, F action entries.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_server.environment.actions import model_actions
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput
from surrogym_server.services.definitions import check_coordinates
from surrogym_shared.checks import LARGEST
from surrogym_shared.nouns import RealStep
from surrogym_shared.spec import EnvironmentSpec

Floats = NDArray[np.float64]

MOST_STEPS = 100_000  # largest number of real steps that a budget may have, as in a specification
MOST_THREADS = 1_024
FARTHEST = 1e6  # a state may be this number of widths of its range outside the range; beyond, a fit loses digits
SHOWN = 80  # an error message shows at most this number of characters of a wrong value


def require_specification(given: object) -> None:
    """Raise ``InvalidInput`` if ``given`` is not a specification. If it is an environment, the message proposes its
    method ``spec``, which returns one."""
    if not isinstance(given, EnvironmentSpec):
        kind = type(given).__name__
        hint = f": give {kind}.spec()" if callable(getattr(given, "spec", None)) else ""
        raise InvalidInput(f"spec: expected an EnvironmentSpec, got {kind}{hint}")


def whole(what: str, value: Any, low: int, high: int, why: str = "") -> int:
    """Return ``value`` as an int if it is a whole number from ``low`` to ``high``; otherwise raise ``InvalidInput``.

    Args:
        what: name of the value in the message.
        value: the value to check.
        low: smallest number that is allowed.
        high: largest number that is allowed.
        why: what the limits mean, such as ", the rest of the budget"; the message contains it.
    """
    try:
        number = None if isinstance(value, bool | np.bool_) else operator.index(value)
    except TypeError:
        number = None
    if number is None or not low <= number <= high:
        raise InvalidInput(f"{what}: expected a whole number from {low} to {high}{why}, got {_shown(value)}")
    return number


def share(what: str, value: Any) -> float:
    """Return a target confidence index as a float if it is above 0.5 and below 1; otherwise raise ``InvalidInput``."""
    if isinstance(value, bool) or not isinstance(value, float | np.floating | int) or not 0.5 < value < 1:
        raise InvalidInput(f"{what}: expected a number above 0.5 and below 1, got {_shown(value)}")
    return float(value)


def states(definition: EnvironmentDefinition, what: str, values: Any) -> Floats:
    """Return ``values`` as an array (v, C): v states, at least one, of C coordinates. Raises ``InvalidInput`` if they
    have another shape, are not finite, or lie absurdly far from the sampling range.
    ``what`` is the name of the values in the message."""
    rows = check_coordinates(definition, what, _numbers(what, values))
    if not len(rows):
        raise InvalidInput(f"{what}: expected at least one state, got none")
    return _near(definition, what, rows)


def steps_of(given: Any) -> list[RealStep]:
    """Return one real step, or several, as a list. Raises ``InvalidInput`` for anything else."""
    steps = [given] if isinstance(given, RealStep) else list(given) if isinstance(given, Sequence) else [given]
    for step in steps:
        if not isinstance(step, RealStep):
            raise InvalidInput(f"expected a RealStep, or a list of them, got {_shown(step)}")
    return steps


def real_step(definition: EnvironmentDefinition, step: RealStep) -> RealStep:
    """Check a real step, and return it with arrays: coordinates (C,), action (F,), next coordinates (C,). Raises
    ``InvalidInput`` if the step can't be used."""
    q, q_next = (
        _near(definition, what, check_coordinates(definition, what, _row(what, getattr(step, what))))
        for what in ("coordinates", "next_coordinates")
    )
    u = model_actions(definition, _row("action", step.action))
    reward = _numbers("reward", step.reward)
    if reward.shape != () or not np.isfinite(reward) or abs(reward) > LARGEST:
        raise InvalidInput(
            f"reward: expected a finite number of at most {LARGEST:g} in size, got {_shown(step.reward)}"
        )
    ends = (_truth("terminated", step.terminated), _truth("truncated", step.truncated))
    return RealStep(q[0], u[0], q_next[0], float(reward), *ends)


def _near(definition: EnvironmentDefinition, what: str, rows: Floats) -> Floats:
    """Return the states ``rows`` (n, C) if they are finite and no more than about ``FARTHEST`` widths of the sampling
    range away from it; otherwise raise ``InvalidInput``, with the name ``what`` in the message."""
    if not np.isfinite(rows).all():
        raise InvalidInput(f"{what}: expected finite numbers, got {_shown(rows.tolist())}")
    for index, coordinate in enumerate(definition.coordinates):
        low, high = coordinate.settable
        most = min(LARGEST, max(abs(low), abs(high)) + FARTHEST * (high - low))
        far = np.abs(rows[:, index]) > most
        if far.any():
            raise InvalidInput(
                f"{what}: expected {coordinate.name!r} from {-most:g} to {most:g}, got {rows[far, index][0]:g}"
            )
    return rows


def _numbers(what: str, values: Any) -> Floats:
    try:
        array = np.asarray(values)
    except ValueError:
        array = np.array(None)
    if array.dtype.kind not in "fiub":
        raise InvalidInput(f"{what}: expected numbers, got {_shown(values)}")
    return array.astype(np.float64)


def _row(what: str, values: Any) -> Floats:
    return _numbers(what, values).reshape(1, -1)


def _truth(what: str, value: Any) -> bool:
    if not isinstance(value, bool | np.bool_):
        raise InvalidInput(f"{what}: expected True or False, got {_shown(value)}")
    return bool(value)


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."
