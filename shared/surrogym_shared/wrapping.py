"""Coordinates of an original environment that wrap after a full turn, as an encoder does, without being angles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np

from surrogym_shared.spec import EnvironmentSpec

FEWEST = 20  # in fewer steps, a large change may look like a turn by chance


class Step(Protocol):
    """A real step: the coordinates (C,) before and after it, and the action (F,)."""

    @property
    def coordinates(self) -> Sequence[float]: ...
    @property
    def action(self) -> Sequence[float]: ...
    @property
    def next_coordinates(self) -> Sequence[float]: ...


def undeclared_turns(spec: EnvironmentSpec, steps: Sequence[Step], judged: int) -> str:
    """Say which coordinates wrap in the last ``judged`` of the real steps although they are not declared as angles, by
    which number, and in how many steps. Returns "" if there is none. As in a log, a coordinate wraps if it jumps by a
    known full turn, apart from the change that its motion predicts.

    Examples:
        "pole jumps by 2048 in 2 of 30 steps, as an angle or a clock in counts does: multiply it by 2 pi / 2048, and
        declare it as an angle"
    """
    return "; ".join(_undeclared(spec, steps, judged)) if judged and len(steps) >= FEWEST else ""


def _undeclared(spec: EnvironmentSpec, steps: Sequence[Step], judged: int) -> Iterator[str]:
    from surrogym_shared.logs.drafting import turn_of  # imported late, like all that reads logs

    read = np.array([c.lag is None for c in spec.coordinates])
    before, after = np.array([step.coordinates for step in steps]), np.array([step.next_coordinates for step in steps])
    q, q_next, u = before[:, read], after[:, read], np.array([step.action for step in steps])
    for i, coordinate in enumerate(c for c in spec.coordinates if c.lag is None):
        if coordinate.kind != "linear" or (turn := turn_of(q, u, q_next, np.arange(len(q)), i)) is None:
            continue
        jumps = int((np.abs(q_next - q)[-judged:, i] > turn.size / 2).sum())
        if jumps:
            scaled = "" if turn.unit == "radians" else f"multiply it by 2 pi / {turn.size:g}, and "
            unit = f", as an angle or a clock in {turn.unit} does" if turn.unit else ""
            yield (
                f"{coordinate.name} jumps by {turn.size:.4g} in {jumps} of {judged} steps{unit}: {scaled}declare it as "
                "an angle"
            )
