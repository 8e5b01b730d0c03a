"""Conversion of a real step to the sample that answers a query."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
from pydantic import ValidationError

from surrogym_sampler.original.errors import StepFailed
from surrogym_shared.distributions import Array
from surrogym_shared.faults import first_fault
from surrogym_shared.nouns import RealStep
from surrogym_shared.wire import NewSample, Query, StepQuery


def reset_seed(query: Query, design_seed: int) -> int:
    """Return the seed of a rollout's reset. It differs between attempts, and is the same on any server for the same
    query and design."""
    return int(np.random.SeedSequence([design_seed, query.number, query.attempt]).generate_state(1)[0])


def sample_of(query: Query, step: RealStep, size: int, number: int = 0) -> NewSample:
    """Return the sample of one step of a query.

    Args:
        query: the query.
        step: the real step.
        size: number of coordinates.
        number: number of the step in the query's action sequence, from 0.

    Raises:
        StepFailed: the step is not a ``RealStep``, has numbers that are not finite, or arrays of the wrong shape.
    """
    if not isinstance(step, RealStep):
        raise StepFailed(f"expected a RealStep from the environment, got {_kind(step)}: return a RealStep")
    try:
        return NewSample(
            query_id=query.id,
            lease_token=query.lease_token,
            step=number,
            coordinates=_numbers(step.coordinates, size, "coordinates"),
            action=_numbers(step.action, len(_requested_actions(query)[number]), "action"),
            next_coordinates=_numbers(step.next_coordinates, size, "next_coordinates"),
            reward=_number(step.reward),
            terminated=bool(step.terminated),
            truncated=bool(step.truncated),
            observation=_entries(step.observation),
            next_observation=_entries(step.next_observation),
        )
    except ValidationError as error:
        raise StepFailed(
            f"expected a real step with finite numbers, got one with an error: {first_fault(error, got=True)}; "
            "correct the environment"
        ) from error


def _requested_actions(query: Query) -> list[list[float]]:
    """Return the actions of a query's T steps (T, F)."""
    return [query.action] if isinstance(query, StepQuery) else query.actions


def _numbers(values: Any, size: int, what: str) -> list[float]:
    array = _floats(values, what)
    if array.shape != (size,):
        raise StepFailed(
            f"expected the shape ({size},) for {what} of a real step, got {array.shape}: correct the environment"
        )
    numbers: list[float] = array.tolist()
    return numbers


def _entries(values: Any) -> list[float] | None:
    return None if values is None else _floats(values, "an observation").ravel().tolist()


def _number(value: Any) -> float:
    number = _floats(value, "the reward")
    if number.shape != ():
        raise StepFailed(
            f"expected a number for the reward of a real step, got the shape {number.shape}: correct the environment"
        )
    return float(number)


def _floats(values: Any, what: str) -> Array:
    """Convert numbers to an array; raise ``StepFailed``, which names what they are, if they are none."""
    if values is not None:  # numpy makes NaN of None
        with suppress(TypeError, ValueError, ArithmeticError):
            return np.asarray(values, dtype=np.float64)
    raise StepFailed(f"expected numbers for {what} of a real step, got {_kind(values)}: correct the environment")


def _kind(value: Any) -> str:
    return "None" if value is None else f"an object of the type {type(value).__name__}"
