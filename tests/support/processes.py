"""What chemical processes of the benchmarks have in common: each observes its two concentrations and has one input."""

from __future__ import annotations

from collections.abc import Mapping

from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform

Range = tuple[float, float]


def process_spec(
    name: str, unit: str, ranges: Mapping[str, Range], start: Mapping[str, Range], action: Range
) -> EnvironmentSpec:
    """The specification of a process with 100 steps in an episode, from the ranges and starts of its coordinates."""
    return EnvironmentSpec(
        environment=name,
        coordinates=tuple(
            Coordinate(name=coordinate, unit=unit, sampling=Uniform(low=low, high=high))
            for coordinate, (low, high) in ranges.items()
        ),
        observation=tuple(
            ObservationEntry(name=coordinate, term=Term.linear(**{coordinate: 1})) for coordinate in ranges
        ),
        action=BoxAction(low=action[:1], high=action[1:]),
        start={coordinate: Uniform(low=low, high=high) for coordinate, (low, high) in start.items()},
        time_limit=100,
    )
