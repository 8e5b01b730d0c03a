"""Sampling ranges and starts of coordinates, from what a simulator declares and what random steps reached.

Shapes: n values, V variables of the state, D observation entries.
"""

from __future__ import annotations

import math

import numpy as np

from surrogym_sampler.original.describing.exploring import Seen
from surrogym_sampler.original.describing.probing import Probed
from surrogym_sampler.original.protocol import Array
from surrogym_sampler.original.simulator import Simulator
from surrogym_shared.spec import Coordinate, Fixed, Uniform, limits

FASTER = 1.5  # largest speed as a multiple of the observed one, because a policy may be faster than random actions
MARGIN = 0.25  # the sampling range is wider than the observed range, on each side, by this share of the observed range
SINGLE = 1e-6  # relative rounding error of an observation in single precision
# If a joint moves more than this share of the distance between its two stops in one step, it may meet a stop from
# anywhere. Its sampling range then includes the stops.
SHORT_WAY = 0.05
UNKNOWN_SPEED = 1.0  # assumed largest speed of a variable that never moved, in the simulator's unit


class Ranges:
    """Chooses the sampling range and the starts of each variable of a simulator. A variable is given by its index.

    Args:
        simulator: the simulator.
        seen: the explored steps.
        probed: results of repeated steps.
        visited: all n states of the explored episodes, with V variables each (n, V).
    """

    def __init__(self, simulator: Simulator, seen: Seen, probed: Probed, visited: Array) -> None:
        self._simulator, self._seen, self._probed, self._visited = simulator, seen, probed, visited

    def coordinate(self, index: int) -> Coordinate:
        """Return the coordinate of the variable ``index``, with its kind and sampling range."""
        variable = self._simulator.variables[index]
        if variable.name in self._probed.turns:
            circle = Uniform(low=-math.pi, high=math.pi)
            return Coordinate(name=variable.name, kind="angle", sampling=circle, unit="rad")
        kind = "constant" if self._is_constant(index) else "linear"
        low, high = self._range(index, constant=kind == "constant")
        return Coordinate(name=variable.name, kind=kind, sampling=Uniform(low=low, high=high))

    def start(self, index: int, coordinate: Coordinate) -> Uniform | Fixed:
        """Return the distribution of a coordinate's starts.

        If a schedule sets the coordinate, its starts have the range of the schedule. A constant with declared limits
        starts anywhere in its sampling range. Otherwise, the range is that of the observed starts, widened because the
        range of n uniform draws is too narrow on average.
        """
        if coordinate.name in self._simulator.scheduled:
            low, high = self._simulator.scheduled[coordinate.name]
            return Uniform(low=low, high=high) if low < high else Fixed(value=low)
        if coordinate.kind == "constant" and self._simulator.variables[index].limited:
            return Uniform(low=limits(coordinate.sampling)[0], high=limits(coordinate.sampling)[1])
        starts = self._seen.starts[:, index]
        if coordinate.kind == "angle":
            starts = _on_an_arc(starts)
        low, high = float(starts.min()), float(starts.max())
        if high - low <= 1e-12 * max(1.0, abs(low)):
            return Fixed(value=low)
        wider = (high - low) / (len(starts) - 1)
        if coordinate.kind == "angle" and high - low + 2 * wider >= 2 * math.pi:
            return Uniform(low=-math.pi, high=math.pi)
        return Uniform(low=low - wider, high=high + wider)

    def _is_constant(self, index: int) -> bool:
        """Return whether a variable is constant in every episode and may differ between episodes."""
        variable, seen = self._simulator.variables[index], self._seen
        if variable.mechanical:
            return False
        moved = (seen.states[:, index] != seen.next_states[:, index]).any()
        return variable.motion == "held" or not moved

    def _range(self, index: int, *, constant: bool) -> tuple[float, float]:
        """Return the sampling range of a variable, cut to the limits that the observation space declares for it."""
        low, high = self._reached(index, constant=constant)
        for shown, ends in zip(self._seen.observations.T, self._shown_limits(), strict=True):
            within = ends[0] <= self._visited[:, index].min() and self._visited[:, index].max() <= ends[1]
            if within and np.allclose(shown, self._seen.next_states[:, index], rtol=SINGLE, atol=SINGLE):
                low, high = max(low, float(ends[0])), min(high, float(ends[1]))
        return low, high

    def _shown_limits(self) -> Array:
        """Return the limits (D, 2) of the observation's entries; infinite if none are declared."""
        given, entries = self._simulator.shown_limits, self._seen.observations.shape[1]
        fits = given is not None and given.shape == (entries, 2)
        return given if given is not None and fits else np.tile([-np.inf, np.inf], (entries, 1))

    def _reached(self, index: int, *, constant: bool) -> tuple[float, float]:
        """Return the sampling range of a variable from its declared limits, or else from the values that random actions
        reached."""
        variable, seen = self._simulator.variables[index], self._visited[:, index]
        low, high = float(seen.min()), float(seen.max())
        if variable.motion == "speed":
            fastest = FASTER * max(abs(low), abs(high)) or UNKNOWN_SPEED
            return -fastest, fastest
        # An object that no actuator drives moves only if others push it. Its limits may be far from where it usually
        # is, so they are not used as its sampling range.
        pushed = variable.motion == "slide" and not variable.driven
        trusted = not pushed and (self._probed.stays or constant)
        if variable.low is not None and variable.high is not None and trusted:
            if variable.motion in ("slide", "turn"):
                return self._before_the_stops(index, variable.low, variable.high)
            return min(low, variable.low), max(high, variable.high)
        if pushed and variable.limited:
            near = self._seen.starts[:, index]
            wider = float(np.ptp(near)) or MARGIN * (high - low)
            return float(near.min()) - wider, float(near.max()) + wider
        margin = (0.0 if constant else MARGIN) * (high - low)
        return low - margin, high + margin

    def _before_the_stops(self, index: int, low: float, high: float) -> tuple[float, float]:
        """Return the sampling range of a joint with stops at ``low`` and ``high``.

        A step that meets a stop is not smooth. So the range ends before each stop, at a distance of the joint's largest
        change in one step. If this change is a large part of the joint's whole range, stops are met from everywhere,
        and the sampling range is the whole range. It always contains all starts.
        """
        seen, starts = self._seen, self._seen.starts[:, index]
        way = FASTER * float(np.abs(seen.next_states[:, index] - seen.states[:, index]).max())
        if way > SHORT_WAY * (high - low):
            way = 0.0
        return min(low + way, float(starts.min())), max(high - way, float(starts.max()))


def _on_an_arc(angles: Array) -> Array:
    """Return the same angles (n,) with full turns (2 pi) added so that they lie on the shortest arc that contains them
    all.

    The middle of the arc is within half a turn of 0. So angles just below pi, and those just above that were wrapped to
    -pi, become neighbours again.
    """
    turn = 2 * math.pi
    placed = np.sort(np.mod(angles, turn))
    gaps = np.diff(np.append(placed, placed[0] + turn))
    first = placed[(int(gaps.argmax()) + 1) % len(placed)]
    arc: Array = np.mod(angles - first, turn) + first
    middle = (arc.min() + arc.max()) / 2
    return arc - turn * round(float(middle) / turn)
