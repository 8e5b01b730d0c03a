"""A controller in NumPy, which defines what the code for every target must compute.

Shapes: N controllers at once, C coordinates, R measurements, D observation entries, A outputs, F action entries.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.limits import is_near
from surrogym_shared.rates import within_rates
from surrogym_trainer.deployment.controller import (
    LATE,
    LIMITED,
    NO_ACTION,
    NOT_FINITE,
    OUT_OF_RANGE,
    Array,
    Controller,
    Decision,
    Guard,
    KeptLimit,
    Observed,
)

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
TURN = 2 * np.pi


@dataclass(frozen=True, eq=False)
class Memory:
    """The state of N controllers between two steps: the last coordinates and action."""

    coordinates: Array  # (N, C) coordinates of N controllers in the last step
    action: Array  # (N, F) last action of each of N controllers
    acted: Bools  # (N,) whether each controller has taken a step before
    measured: Bools  # (N,) whether the measurements of the last step had no fault


class Decided(NamedTuple):
    """The result of one decision of N controllers."""

    memory: Memory
    action: Array  # (N, F) action that each of N controllers takes
    status: Ints  # (N,) status of each of N controllers: the bits of its faults, or LIMITED; 0 if the policy acts


def begin(controller: Controller, number: int = 1) -> Memory:
    """Return the memory of ``number`` controllers that have not acted yet."""
    coordinates = np.zeros((number, len(controller.coordinates)))
    return Memory(coordinates, np.zeros((number, len(controller.low))), *np.zeros((2, number), dtype=np.bool_))


def decide(controller: Controller, memory: Memory, measurements: Array, age: Array | float = 0.0) -> Decided:
    """Take one decision of N controllers.

    Args:
        controller: the controller.
        memory: the memory after the previous step.
        measurements: measurements (N, R).
        age: age of the measurements in seconds: (N,), or a single number for all controllers.
    """
    read = np.asarray(measurements, dtype=np.float64)
    status = judged(controller, read, np.broadcast_to(np.asarray(age, dtype=np.float64), len(read)))
    sound = np.where((status == 0)[:, None], read, 0.0)  # faulty measurements may be NaN, and are not used
    coordinates = _placed(controller, memory, sound, status == 0)
    action, wrong = act(controller, observe(controller, coordinates))
    status = np.where((status == 0) & wrong, NO_ACTION, status)
    action = np.where((status == 0)[:, None], action, controller.fallback)
    measured: Bools = (status & ~NO_ACTION) == 0
    if controller.guard is not None:
        acts = measured & _falls_back(controller.guard, memory, coordinates)
        safe = np.stack([_entry(term, coordinates) for term in controller.guard.fallback], axis=1)
        action, status = np.where(acts[:, None], safe, action), np.where(acts, LIMITED, status)
    action = within_rates(controller.rates, coordinates, action)
    remembered = action.astype(np.float32).astype(np.float64)
    return Decided(Memory(coordinates, remembered, np.ones_like(wrong), measured), action, status)


def _falls_back(guard: Guard, memory: Memory, coordinates: Array) -> Bools:
    """Return a mask (N,) of those of N controllers that take the fallback action at coordinates (N, C), because a limit
    would be left soon."""
    now, before = (
        np.stack([_room(limit, q) for limit in guard.limits], axis=1) for q in (coordinates, memory.coordinates)
    )
    known = (memory.acted & memory.measured)[:, None]
    return is_near(np.array([limit.margin for limit in guard.limits]), now, np.where(known, before, now))


def _room(limit: KeptLimit, coordinates: Array) -> Array:
    """Return the distance (N,) of a limited term, at coordinates (N, C), from the nearer end of its range; negative
    outside."""
    value = _entry(limit.term, coordinates)
    return np.minimum(value - limit.low, limit.high - value)


def judged(controller: Controller, read: Array, age: Array) -> Ints:
    """Return the faults (N,) of measurements (N, R) of an age (N,). Each kind of fault has a bit, and the bits are
    summed; 0 without faults."""
    lowest, highest = (np.array([getattr(m, n) for m in controller.measurements]) for n in ("lowest", "highest"))
    finite = np.isfinite(read)
    outside = finite & ((read < lowest) | (read > highest))
    late = ~((age >= 0) & (age <= controller.timeout))
    bits = np.where(~finite.all(1), NOT_FINITE, 0) | np.where(outside.any(1), OUT_OF_RANGE, 0)
    return np.asarray(bits | np.where(late, LATE, 0), dtype=np.int64)


def observe(controller: Controller, coordinates: Array) -> Array:
    """Return the observations (N, D) of coordinates (N, C), rounded to float32."""
    rows = np.stack([_entry(one, coordinates) for one in controller.observation], axis=1)
    return rows.astype(np.float32).astype(np.float64)


def act(controller: Controller, observation: Array) -> tuple[Array, Bools]:
    """Return actions (N, F) for observations (N, D), and a mask (N,) of the rows in which an output of the network is
    not finite."""
    y = scores(controller.decision, observation)
    wrong: Bools = np.logical_not(np.isfinite(y).all(1))
    y = np.where(wrong[:, None], 0.0, y)
    low, high, decision = controller.low, controller.high, controller.decision
    if not decision.counts:
        shown = np.tanh(y) if decision.squash else y
        return np.clip(decision.centre + decision.reach * shown, low, high), wrong
    groups = np.split(y, np.cumsum(decision.counts)[:-1], axis=1)
    chosen = np.stack([group.argmax(1) for group in groups], axis=1)
    return low + chosen * (high - low) / (np.array(decision.counts) - 1), wrong


def scores(decision: Decision, observation: Array) -> Array:
    """Return the network's outputs (N, A) for observations (N, D)."""
    x = np.clip((observation - decision.mean) / decision.deviation, -decision.clip, decision.clip)
    with np.errstate(over="ignore", invalid="ignore"):
        for layer in decision.layers:
            x = x @ layer.weights + layer.bias
            if layer.activation != "none":
                x = np.tanh(x) if layer.activation == "tanh" else np.maximum(x, 0)
    return x


def _placed(controller: Controller, memory: Memory, read: Array, sound: Bools) -> Array:
    """Return the coordinates (N, C) of this step: the measurements, wrapped or clipped, and the lags, which repeat
    earlier values.

    Args:
        controller: the controller.
        memory: the memory after the previous step.
        read: measurements (N, R); 0 where they have a fault.
        sound: mask (N,) of the controllers whose measurements have no fault.
    """
    after = memory.coordinates.copy()
    for i, one in enumerate(controller.measurements):
        after[:, one.place] = wrapped(read[:, i]) if one.angle else np.clip(read[:, i], one.low, one.high)
    known = memory.acted & memory.measured & sound
    for lag in controller.lags:
        match lag.kind:
            case "action":
                value = memory.action[:, lag.source]
            case "steps":
                value = memory.coordinates[:, lag.place] + 1
            case "value":
                value = memory.coordinates[:, lag.source]
            case "change":
                change = after[:, lag.source] - memory.coordinates[:, lag.source]
                value = wrapped(change) if lag.angle else change
            case "sum":
                error = (after[:, lag.source] - lag.set_point) / lag.unit
                value = memory.coordinates[:, lag.place] + np.where(sound, error, 0.0)
        kept = np.where(memory.acted if lag.of_action or lag.kind == "sum" else known, value, lag.start)
        after[:, lag.place] = np.clip(kept, lag.low, lag.high)
    return after


def wrapped(angle: Array) -> Array:
    """Wrap angles to [-pi, pi)."""
    return (angle + np.pi) % TURN - np.pi


def _entry(entry: Observed, coordinates: Array) -> Array:
    total = np.zeros(len(coordinates))
    for part in entry.parts:
        inner = sum((weight * coordinates[:, place] for place, weight in part.weights), np.zeros(len(coordinates)))
        match part.function:
            case "one":
                inner = np.ones_like(inner)
            case "sin":
                inner = np.sin(inner)
            case "cos":
                inner = np.cos(inner)
        total = total + part.coefficient * inner
    return np.clip(total, entry.low, entry.high)
